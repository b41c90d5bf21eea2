"""Which folders this project wrote: only those are ever replaced or removed.

A complete folder is told by what it says of itself: a store by its attributes, a training run by
its `run.json`. One in the making holds `MARKER`, which is the first thing written into it, so that
what a kill leaves behind is known too; logs keep it for good. An empty folder is anybody's.
"""

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import ConfigError

MARKER = ".vla-feature-cache"

LEDGER_SUFFIX = ".files.sqlite"
"""How the name of a store's ledger of file digests ends (`pipeline.base.digests`)."""

_SPEED = "step\tsteps_per_s\tdata_wait_share\t"
"""How the speed begins that a training writes beside its logs (`pipeline.train.log`)."""


@dataclass(frozen=True)
class OutputKind:
    """A kind of output, and how a complete one is told from what somebody else wrote."""

    name: str
    """With its article, as an error calls it."""
    is_one: Callable[[Path], bool]

    def owns(self, path: Path) -> bool:
        """Whether this project may replace what lies there as one of this kind."""
        if self.is_one(path):
            return True
        return path.is_dir() and (self.marks(path) or _is_empty(path))

    def marks(self, path: Path) -> bool:
        """Whether it is marked as one of this kind."""
        return _marked(path) == self.name


def there(path: Path) -> bool:
    """Whether anything has this name, a link to nothing too."""
    return path.exists() or path.is_symlink()


def refuse_foreign(path: Path, kind: OutputKind) -> None:
    """Raise `ConfigError` where something lies at `path` that this project did not write."""
    if there(path) and not kind.owns(path):
        raise ConfigError(
            f"{path}: expected nothing there or {kind.name} that this project wrote, found "
            f"{described(path)}. It was left as it is: move it away, or name another place."
        )


def remove_folder(path: Path, kind: OutputKind) -> None:
    """Remove a folder of this kind, if there is one; of one behind a symbolic link, the link alone.

    Raises `ConfigError` where it is not this project's.
    """
    refuse_foreign(path, kind)
    if path.is_symlink():
        path.unlink()
    elif path.exists():
        with suppress(OSError):  # on a full disk, where only a kill from here on would show
            mark(path, kind)
        for entry in path.iterdir():  # the marker last
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            elif entry.name != MARKER:
                entry.unlink()
        shutil.rmtree(path)


def begin_folder(path: Path, kind: OutputKind) -> None:
    """Make an empty, marked folder, in place of one of this kind that was begun before."""
    remove_folder(path, kind)
    claim(path, kind)


def claim(folder: Path, kind: OutputKind) -> None:
    """Make a folder, or take one of this kind as it is, and mark it.

    Raises `ConfigError` where it is not this project's.
    """
    refuse_foreign(folder, kind)
    folder.mkdir(parents=True, exist_ok=True)
    mark(folder, kind)


def mark(folder: Path, kind: OutputKind) -> None:
    """Write down that a folder is of this kind, unless it says so already."""
    if _marked(folder) != kind.name:
        unmark(folder)  # DVC may have linked it into its cache
        (folder / MARKER).write_text(f"{kind.name}\n", encoding="utf-8")


def unmark(folder: Path) -> None:
    """Take the marker away from a folder that says by itself what it is."""
    (folder / MARKER).unlink(missing_ok=True)


def release(folder: Path, kind: OutputKind) -> None:
    """Take the marker away where a folder by now says by itself what it is."""
    if kind.is_one(folder):
        unmark(folder)


def begins_with(line: str) -> Callable[[Path], bool]:
    """Tells a file by how its first line begins; an empty one is anybody's."""

    def begins(path: Path) -> bool:
        if not path.is_file():
            return False
        with path.open(encoding="utf-8", errors="replace") as file:
            return not (first := file.readline().strip()) or first.startswith(line)

    return begins


def _is_report(folder: Path) -> bool:
    """Whether a command that shows something wrote this folder, or has begun to."""
    if any((folder / sign).exists() for sign in (".report.html.new", LEDGER_SUFFIX)):
        return True
    if (folder / "judged.json").is_file() or _has_speed(folder):
        return True
    if all((folder / f"{table}.csv").is_file() for table in ("slots", "groups", "targets")):
        return True
    page = folder / "report.html"
    if not page.exists() and folder.is_dir():  # of one command, each page in a folder of its own
        parts = list(folder.iterdir())
        ours = all(part.is_dir() and REPORT.owns(part) for part in parts)
        return ours and not all(_is_empty(part) for part in parts)
    return page.is_file() and b'<meta name="pictures"' in page.read_bytes()[: 2**16]


REPORT = OutputKind("a folder of reports", _is_report)
"""What evaluations, inspections, probes, comparisons and trainings show; files are added to it."""


def _has_speed(logs: Path) -> bool:
    """Whether a training's speed lies beside these logs: curves alone are anybody's."""
    speed = logs.with_name(f"{logs.name}.speed.tsv")
    return logs.is_dir() and begins_with(_SPEED)(speed) and speed.stat().st_size > 0


def _is_empty(folder: Path) -> bool:
    """Whether nothing is in it, or a marker alone that a kill cut off before its line."""
    return all(entry.name == MARKER and not entry.stat().st_size for entry in folder.iterdir())


def _marked(folder: Path) -> str | None:
    """The kind that a folder is marked with."""
    try:
        return (folder / MARKER).read_text(encoding="utf-8", errors="replace").strip()
    except (FileNotFoundError, NotADirectoryError):
        return None


def described(path: Path) -> str:
    """What lies there, for an error."""
    if not path.is_dir():
        return "a file" if path.exists() else "a link to nothing"
    names = sorted(entry.name for entry in path.iterdir())
    if not names:
        return "an empty folder"
    return f"a folder with {', '.join(names[:3])}{' …' if len(names) > 3 else ''}"
