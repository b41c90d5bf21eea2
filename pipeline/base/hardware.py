"""The memory and the devices that a process may use.

Limits of memory are those of the process's control groups (version 2) and their parents. torch is
imported inside the functions: it takes over a second, which a command that has nothing to do must
not spend.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.base.errors import ConfigError
from pipeline.base.printed_commands import command

_ROOT = Path("/")
_FILE_PAGES = ("inactive_file", "active_file")
"""Lines of memory.stat for pages of files, which count as used but can be dropped."""


def memory_bytes(root: Path = _ROOT) -> int:
    """Bytes of memory that this process may use; `root` holds proc and sys."""
    return min([_meminfo(root)["MemTotal"], *(limit for limit, _ in _limits(root))])


def available_bytes(root: Path = _ROOT) -> int:
    """Bytes free without swapping; file pages that can be dropped count as free.

    `root` holds proc and sys.
    """
    left = (limit - used for limit, used in _limits(root))
    return max(0, min([_meminfo(root)["MemAvailable"], *left]))


def _limits(root: Path) -> Iterator[tuple[int, int]]:
    """Limit and use, in bytes, of each limited control group, from the process's own upwards."""
    top = root / "sys/fs/cgroup"
    own = top / _read(root / "proc/self/cgroup").rpartition("::/")[2]
    # In a container the path may be the host's; then only the top group exists.
    for group in (own, *own.parents):
        limit, used = _read(group / "memory.max"), _read(group / "memory.current")
        if limit.isdigit() and used.isdigit():
            pages = _numbers(_read(group / "memory.stat"))
            yield int(limit), int(used) - sum(pages.get(name, 0) for name in _FILE_PAGES)
        if group == top:
            break


def _meminfo(root: Path) -> dict[str, int]:
    """Values in bytes; `MemAvailable` exists since Linux 3.14."""
    kilobytes = _numbers(_read(root / "proc/meminfo").replace(":", ""))
    return {name: number * 1024 for name, number in kilobytes.items()}


def _numbers(text: str) -> dict[str, int]:
    """The numbers of lines such as `name number …`."""
    lines = (line.split() for line in text.splitlines())
    return {words[0]: int(words[1]) for words in lines if len(words) > 1 and words[1].isdigit()}


def _read(path: Path) -> str:
    """The text of a file; empty where there is no file."""
    return path.read_text(encoding="ascii").strip() if path.is_file() else ""


if TYPE_CHECKING:
    import torch


def resolve_device(name: str) -> "torch.device":
    """The device of a `device:` param; `auto` is the first CUDA device, or the CPU without one.

    Raises `ConfigError` for a device that this machine or this build of torch does not have.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda"):
            raise RuntimeError(f"{device.type} devices are not supported")
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            f"device: {name}: expected auto, cpu or a device of this machine "
            f"(CUDA devices found: {torch.cuda.device_count()}): {str(error).splitlines()[0]}. "
            f"Set device to auto or cpu, or install what {command('doctor')} says"
        ) from None
    return device


def use_bfloat16(amp: Literal["auto", "off", "bfloat16"], device: "torch.device") -> bool:
    """Whether the forward pass runs under bfloat16 autocast.

    `auto` means yes on a CUDA device with bfloat16 arithmetic. Elsewhere autocast is rarely faster,
    and float32 keeps a run reproducible to the bit.
    """
    import torch

    if amp == "auto":
        return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    return amp == "bfloat16"
