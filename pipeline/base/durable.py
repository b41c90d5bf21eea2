"""Files and folders that survive a kill: written beside their place, synced, renamed into it."""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import JsonValue
from safetensors import SafetensorError, safe_open

from pipeline.base.border import MOST_WEIGHT, Border
from pipeline.base.errors import CheckpointIncomplete, DiskFull
from pipeline.base.ownership import (
    OutputKind,
    begin_folder,
    mark,
    refuse_foreign,
    remove_folder,
    there,
    unmark,
)

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")

FULL = (errno.ENOSPC, errno.EDQUOT)
DIGEST = "document_sha256"
"""Under which key a document carries the digest of all its others."""
RUN_FILES = Border(
    CheckpointIncomplete,
    "Copy it again, name another, or remove its folder and run the training that writes it "
    "(stages.train_head or stages.finetune) again.",
)
"""What is said of a file of a run that is not as it was written."""
_DOCUMENT = dict[str, JsonValue]
_MOST_BYTES = 64 * 2**20
"""Of a document: the normalisation of a wide policy's features takes 20 MB."""
_MOST_WEIGHT = 2 * MOST_WEIGHT
"""Of a document with its digest: 80,000 episodes weigh 4 million, a million steps' rows 5."""


@contextmanager
def disk_full_named(place: Path) -> Generator[None]:
    """Turn "no space left" and "quota exceeded" into `DiskFull` naming the place."""
    try:
        yield
    except DiskFull:
        raise
    except (OSError, SafetensorError) as error:
        # safetensors says the number in words only.
        said = any(f"(os error {number})" in str(error) for number in FULL)
        if not said and getattr(error, "errno", None) not in FULL:
            raise
        raise DiskFull(
            f"{place}: no space left on the device ({free_bytes(place) / 2**20:.0f} MiB free). "
            "What was complete before is kept: make room and run the same command again."
        ) from error


def free_bytes(path: Path) -> int:
    """Bytes free on the file system that holds `path` or its nearest existing parent."""
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free


def fresh(path: Path) -> Path:
    """The path, with nothing at it.

    DVC restores files as hard links into its cache, so that writing into one would alter the
    cache; a new file of the same name leaves it alone.
    """
    path.unlink(missing_ok=True)
    return path


def replace_folder(folder: Path, write: Callable[[Path], None], kind: OutputKind) -> None:
    """Put what `write` writes into a temporary folder at `folder`, in place of what is there.

    A kill leaves the old content or the new, as `put_in_place` does. Raises `DiskFull` with the old
    in place, and `ConfigError` where something that is not of this kind lies there.
    """
    recover_folder(folder, kind)
    temporary = _beside(folder, "new")
    with disk_full_named(folder):
        try:
            begin_folder(temporary, kind)
            write(temporary)
            for file in temporary.iterdir():
                sync(file)
            sync(temporary)
        except BaseException:
            remove_folder(temporary, kind)
            raise
    put_in_place(temporary, folder, kind)


def recover_folder(folder: Path, kind: OutputKind) -> None:
    """Undo or complete a `replace_folder` that a kill stopped."""
    recover(folder, kind)
    remove_folder(_beside(folder, "new"), kind)


def previous_path(target: Path) -> Path:
    """Where `put_in_place` keeps what was at `target`."""
    return _beside(target, "previous")


_LINK_ENDS = "/."
"""How a link that is kept ends: nothing is written into the folder behind it."""


def _is_kept_link(path: Path) -> bool:
    # A Path would leave the end out.
    return path.is_symlink() and os.readlink(path).endswith(_LINK_ENDS)  # noqa: PTH115


KEPT = OutputKind("a store of before, kept for its rows,", _is_kept_link)
"""Marked when it is kept: a copy or a link that a user made under that name is not one."""

HELD = OutputKind("a folder that is being replaced,", lambda path: False)


def put_in_place(complete: Path, target: Path, kind: OutputKind, *, keep: bool = False) -> None:
    """Rename a complete folder to `target`; what was there is removed, or kept as `<name>.previous`
    in place of what was kept before. Of a symbolic link the folder behind it stays as it is.

    A kill leaves the old one or the new. For one instant the old one lies in `<target>.replaced`,
    or in `<target>.keeping`, from where `recover` brings it back. Raises `ConfigError` where
    something that is not of this kind lies in one of these places.
    """
    recover(target, kind)
    if keep:
        refuse_foreign(previous_path(target), KEPT)
    unmark(complete)
    if there(target):
        # Not `.old` itself: one that a user made is a copy that somebody wants.
        held = _beside(target, "keeping" if keep else "replaced")
        begin_folder(held, HELD)
        target.rename(held / target.name)
    complete.rename(target)
    sync(target.parent)
    recover(target, kind)


def recover(target: Path, kind: OutputKind) -> None:
    """Undo or complete a `put_in_place` that a kill stopped.

    Raises `ConfigError` where something that is not of this kind lies in one of its places.
    """
    refuse_foreign(target, kind)
    for suffix in ("replaced", "keeping"):
        held = _beside(target, suffix)
        refuse_foreign(held, HELD)
        old = held / target.name
        if there(old) and not there(target):
            old.rename(target)
        elif there(old) and suffix == "keeping":
            _keep(old, target)
        remove_folder(held, HELD)


def _keep(old: Path, target: Path) -> None:
    """Make what was at `target` the previous one; a kill leaves `old` until that is done."""
    previous = previous_path(target)
    if old.is_symlink():
        # It may be relative to the folder of `target`, and `old` lies one deeper.
        behind = os.path.realpath(target.parent / old.readlink())
        remove_folder(previous, KEPT)
        previous.symlink_to(behind + _LINK_ENDS)
        return
    mark(old, KEPT)
    remove_folder(previous, KEPT)
    old.rename(previous)


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document, atomically; its floats come back to the bit. Raises `DiskFull`."""
    temporary = _beside(path, "new")
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    with disk_full_named(path):
        temporary.write_text(text + "\n", encoding="utf-8")
        sync(temporary)
    temporary.rename(path)


def write_with_digest(path: Path, document: Mapping[str, Any]) -> None:
    """As `write_document`, with a digest of the document in it, which reading checks."""
    read = json.loads(json.dumps(document, allow_nan=False))  # where all keys are strings
    write_document(path, {**document, DIGEST: _document_sha256(read)})


def read_document(path: Path, model: type[T]) -> tuple[T, dict[str, Any]]:
    """The JSON document at `path` as the model, and as it is, without the digest of itself.

    Raises `CheckpointIncomplete` where it is missing, is none, or is not what its digest is of.
    """
    text = RUN_FILES.read_bytes(path, _MOST_BYTES)
    document = RUN_FILES.parse_json(text, _DOCUMENT, path, _MOST_WEIGHT)
    digest = document.pop(DIGEST, None)
    try:
        altered = digest not in (None, _document_sha256(document))
    except ValueError as error:
        raise RUN_FILES.refusal(path, error) from None
    if altered:
        why = f"it was altered since it was written: its {DIGEST} is of another content"
        raise RUN_FILES.refusal(path, why)
    most = _MOST_WEIGHT if digest else MOST_WEIGHT
    return RUN_FILES.parse_json(text, model, path, most), document


def _document_sha256(document: Mapping[str, Any]) -> str:
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def write_tensors(path: Path, tensors: Mapping[str, "Tensor"]) -> str:
    """Write tensors as safetensors and return the sha256 of the file."""
    from safetensors.torch import save_file  # torch: most that write files here hold no tensor

    save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, path)
    # safetensors writes for the owner alone; other files have what the umask leaves.
    path.chmod(path.parent.stat().st_mode & 0o666)
    return sha256_of(path)


def read_tensors(path: Path, sha256: str) -> "dict[str, Tensor]":
    """The tensors at `path`; `CheckpointIncomplete` when they are not those that were written."""
    from safetensors.torch import load_file

    check_digest(path, sha256)
    with RUN_FILES.foreign(path, "cannot be read"):
        return load_file(path)


def check_digest(path: Path, sha256: str) -> None:
    """Raise `CheckpointIncomplete` where the file at `path` is not the one that was written."""
    RUN_FILES.check_file(path)
    with RUN_FILES.foreign(path, "cut off or damaged"), safe_open(path, "numpy"):
        pass  # the head says how long the file is: none is read without an end
    if sha256_of(path) != sha256:
        raise RUN_FILES.refusal(path, "its sha256 is not the one written with it")


def sha256_of(path: Path) -> str:
    """The sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(f"{path.name}.{suffix}")
