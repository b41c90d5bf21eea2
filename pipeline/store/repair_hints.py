"""Full commands to run when a store is damaged.

Each names the damaged store, which may be another than that of params.yaml.
"""

import re
import shlex
from pathlib import Path

from pipeline.base.commands import command
from pipeline.base.config import setting

KNOWN = ".known"
"""The folder within a part for interrupted builds of other plans."""
_STORE = re.compile(r"(?P<base>.+?\.zarr)(?:\.part|\.previous)?")


def extract_command(store: Path) -> str:
    """The command that makes a store or completes its build."""
    return command("extract", setting("extract.store", store))


def gc_command(path: Path) -> str:
    """The command that removes an unfinished build."""
    return command("store", "gc", shlex.quote(str(path)), "--remove")


def restore_command(archive: Path) -> str:
    """The command that restores a store beside its archive."""
    name = archive.stem.removesuffix(".archive")
    store = archive.with_name(f"{name if name != archive.stem else name + '.restored'}.zarr")
    places = setting("archive.output", archive), setting("archive.store", store)
    return command("archive", "--restore", *places)


def mend(path: Path) -> str:
    """What to do about a damaged store or build; `path` is its folder or a file in it."""
    folder, store = _owner(path)
    for place in (path, *path.parents):
        if place.parent.name == KNOWN:
            return f"Remove {place}, then run {extract_command(store)}."
    if folder != store:
        return f"Remove it with {gc_command(folder)}, then run {extract_command(store)}."
    repair = command("verify", "--repair", setting("verify.store", store))
    return f"Run {repair}, which keeps what is sound, then what it says."


def start_over(path: Path) -> str:
    """What to do where a store's or build's root metadata no longer say what it was made of."""
    folder, store = _owner(path)
    if folder != store:
        return mend(path)
    return (
        "Without them its feature rows are of no use, and --repair cannot begin. Remove or rename "
        f"{store}, then run {extract_command(store)}, which computes all of it, or "
        f"{command('archive', '--restore')}, which takes it from an archive."
    )


def _owner(path: Path) -> tuple[Path, Path]:
    """The store or build at or around a path, and the store's final path."""
    for folder in (path, *path.parents):
        if match := _STORE.fullmatch(folder.name):
            return folder, folder.with_name(match["base"])
    return path, path
