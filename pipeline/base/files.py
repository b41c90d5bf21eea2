"""Files and folders that survive a kill, and the marker of those that this project wrote.

A file or folder is written beside its place, synced and renamed. This project replaces and removes
only what it wrote. A complete store or training is known by its content; every other folder has
`MARKER`, which is the first file written into it and the last one removed. An empty folder may
always be used.
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import JsonValue
from safetensors import SafetensorError, safe_open

from pipeline.base.documents import MOST_WEIGHT, Border
from pipeline.base.errors import CheckpointIncomplete, ConfigError, DiskFull

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")

MARKER = ".vla-feature-cache"
FULL = (errno.ENOSPC, errno.EDQUOT)
DIGEST = "document_sha256"
"""The key in a document for the digest of all other entries."""
RUN_FILES = Border(
    CheckpointIncomplete,
    "Copy it again, name another, or remove its folder and run the training that writes it "
    "(stages.train_head or stages.finetune) again.",
)
"""Refuses a damaged file of a training."""
_DOCUMENT = dict[str, JsonValue]
_MOST_BYTES = 64 * 2**20
"""Most bytes of a document; the normalisation of a wide policy's features takes 20 MB."""
_MOST_WEIGHT = 2 * MOST_WEIGHT
"""Most weight of a document with a digest; a million steps' rows weigh 5 million."""


@dataclass(frozen=True)
class OutputKind:
    """A kind of output; `name` is the line in its marker."""

    name: str
    """With its article, as it appears in errors."""
    is_one: Callable[[Path], bool] = lambda path: False
    """Recognises a complete one that has no marker."""
    advice: str = ""
    """What an error adds if something else lies in the place."""

    def owns(self, path: Path) -> bool:
        """Whether this project may replace what lies at `path` as one of this kind."""
        return (path.is_dir() and (self.marks(path) or _is_empty(path))) or self.is_one(path)

    def marks(self, path: Path) -> bool:
        """Whether `path` has the marker of this kind."""
        return _marked(path) == self.name


def there(path: Path) -> bool:
    """Whether anything has this name, even a dangling link."""
    return path.exists() or path.is_symlink()


def described(path: Path) -> str:
    """What lies at `path`, for an error."""
    if not path.is_dir():
        return "a file" if path.exists() else "a link to nothing"
    names = sorted(entry.name for entry in path.iterdir())
    if not names:
        return "an empty folder"
    return f"a folder with {', '.join(names[:3])}{' …' if len(names) > 3 else ''}"


def refuse_foreign(path: Path, kind: OutputKind) -> None:
    """Raise `ConfigError` where something lies at `path` that this project did not write."""
    if there(path) and not kind.owns(path):
        raise ConfigError(
            f"{path}: expected nothing there or {kind.name} that this project wrote, found "
            f"{described(path)}. It was left as it is: move it away, or name another place."
            f"{kind.advice}"
        )


def remove_folder(path: Path, kind: OutputKind) -> None:
    """Remove a folder of this kind, if there is one; if it is a symbolic link, only the link.

    Files are removed before folders, so that after a kill the rest does not look complete, and the
    marker is removed last. Raises `ConfigError` where it is not this project's.
    """
    refuse_foreign(path, kind)
    if path.is_symlink():
        path.unlink()
    elif path.exists():
        with suppress(OSError):  # a full disk, where the marker matters only after a kill
            mark(path, kind)
        _empty(path, MARKER)
        shutil.rmtree(path)


def begin_folder(path: Path, kind: OutputKind, but: str = MARKER) -> None:
    """Make an empty, marked folder, or empty one of this kind; its entry `but` stays."""
    if path.is_symlink():
        remove_folder(path, kind)
    claim(path, kind)
    _empty(path, MARKER, but)


def _empty(folder: Path, *but: str) -> None:
    for entry in sorted(folder.iterdir(), key=Path.is_dir):
        if entry.name not in but:
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()


def claim(folder: Path, kind: OutputKind) -> None:
    """Make a folder, or keep one of this kind, and mark it.

    Raises `ConfigError` where it is not this project's.
    """
    refuse_foreign(folder, kind)
    folder.mkdir(parents=True, exist_ok=True)
    mark(folder, kind)


def mark(folder: Path, kind: OutputKind) -> None:
    """Write the marker of this kind into a folder, unless it is there."""
    if _marked(folder) != kind.name:
        unmark(folder)  # it may be a link into DVC's cache
        (folder / MARKER).write_text(f"{kind.name}\n", encoding="utf-8")


def unmark(folder: Path) -> None:
    """Remove the marker from a folder that is known by its content."""
    (folder / MARKER).unlink(missing_ok=True)


def replace_folder(folder: Path, write: Callable[[Path], None], kind: OutputKind) -> None:
    """Replace `folder` by a temporary folder into which `write` has written.

    A kill leaves the old or the new content, as in `put_in_place`. Raises `DiskFull` and keeps the
    old content, and `ConfigError` where something that is not of this kind lies there.
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
    temporary = _beside(folder, "new")
    recover(temporary, folder, kind)
    remove_folder(temporary, kind)


def put_in_place(complete: Path, target: Path, kind: OutputKind) -> None:
    """Rename a complete folder to `target` and remove what was there; if a link, only the link.

    A kill leaves the old or the new one: the old one first moves into the complete folder, and
    `recover` brings it back from there. Raises `ConfigError` where the old one is not of this kind.
    """
    refuse_foreign(target, kind)
    unmark(complete)
    if there(target):
        target.rename(complete / REPLACED)
    complete.rename(target)
    sync(target.parent)
    recover(complete, target, kind)


def recover(complete: Path, target: Path, kind: OutputKind) -> None:
    """Undo or complete a `put_in_place` that a kill stopped.

    Raises `ConfigError` where something at `target` is not of this kind.
    """
    refuse_foreign(target, kind)
    if there(complete / REPLACED) and not there(target):
        (complete / REPLACED).rename(target)
    # It is still in the complete folder if the user has restored another `target`.
    for replaced in (complete / REPLACED, target / REPLACED):
        if replaced.is_symlink():
            replaced.unlink()
        remove_folder(replaced, kind)


REPORT = OutputKind(
    "a folder of reports",
    advice=f" (Reports of earlier versions hold no {MARKER}: move or remove these.)",
)
"""The reports of evaluations, inspections, probes, comparisons and trainings; keeps its marker."""
REPLACED = ".replaced"
"""The place of the old folder in the new one until its removal."""


def _is_empty(folder: Path) -> bool:
    """Whether a folder has nothing in it, or only an empty marker that a kill left."""
    return all(entry.name == MARKER and not entry.stat().st_size for entry in folder.iterdir())


def _marked(folder: Path) -> str | None:
    """The name in a folder's marker; None without a marker."""
    try:
        return (folder / MARKER).read_text(encoding="utf-8", errors="replace").strip()
    except (FileNotFoundError, NotADirectoryError):
        return None


@contextmanager
def disk_full_named(place: Path) -> Generator[None]:
    """Turn "no space left" and "quota exceeded" into a `DiskFull` that names the place."""
    try:
        yield
    except DiskFull:
        raise
    except (OSError, SafetensorError) as error:
        # safetensors gives the error number only in its text.
        in_words = any(f"(os error {number})" in str(error) for number in FULL)
        if not in_words and getattr(error, "errno", None) not in FULL:
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
    """The path, after removing a file there.

    DVC restores files as hard links into its cache, so a write into one would change the cache; a
    new file of the same name does not.
    """
    path.unlink(missing_ok=True)
    return path


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's list of entries, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document atomically; its floats are read back bit for bit. Raises `DiskFull`."""
    temporary = _beside(path, "new")
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    with disk_full_named(path):
        temporary.write_text(text + "\n", encoding="utf-8")
        sync(temporary)
    temporary.rename(path)


def write_with_digest(path: Path, document: Mapping[str, Any]) -> None:
    """Like `write_document`, with a digest of the document, which `read_document` checks."""
    read = json.loads(json.dumps(document, allow_nan=False))  # so that all keys are strings
    write_document(path, {**document, DIGEST: _document_sha256(read)})


def read_document(path: Path, model: type[T]) -> tuple[T, dict[str, Any]]:
    """The JSON document at `path` as the model, and as a dictionary without its digest.

    Raises `CheckpointIncomplete` where it is missing, not a JSON document, or does not give its
    digest.
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
    from safetensors.torch import save_file  # torch: most callers here have no tensor

    save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, path)
    # safetensors writes only for the owner; give the file the folder's mode.
    path.chmod(path.parent.stat().st_mode & 0o666)
    return sha256_of(path)


def read_tensors(path: Path, sha256: str) -> "dict[str, Tensor]":
    """The tensors at `path`; `CheckpointIncomplete` if the file was changed or damaged."""
    from safetensors.torch import load_file

    check_digest(path, sha256)
    with RUN_FILES.foreign(path, "cannot be read"):
        return load_file(path)


def check_digest(path: Path, sha256: str) -> None:
    """Raise `CheckpointIncomplete` unless the safetensors file at `path` has this sha256."""
    RUN_FILES.check_file(path)
    with RUN_FILES.foreign(path, "cut off or damaged"), safe_open(path, "numpy"):
        pass  # the header gives the file's length: refuses a truncated one before reading all
    if sha256_of(path) != sha256:
        raise RUN_FILES.refusal(path, "its sha256 is not the one written with it")


def sha256_of(path: Path) -> str:
    """The sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(f"{path.name}.{suffix}")
