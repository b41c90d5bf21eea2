"""How DVC can keep outputs in its cache without a second copy: tried, as DVC tries it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvc.config import Config, ConfigError
from dvc_objects.fs import LocalFileSystem
from dvc_objects.fs.generic import test_links as try_links

from pipeline.base.config import Params
from pipeline.look.doctor.findings import Finding, missing, note, ok

LINKS = ("reflink", "hardlink", "symlink", "copy")
WANTED = "dvc config cache.type reflink,hardlink,symlink,copy"


@dataclass(frozen=True)
class Cache:
    """DVC's cache and how this repository can share files with it."""

    folder: Path
    types: tuple[str, ...]
    """`cache.type`: what DVC tries, in order."""
    working: tuple[str, ...]
    """What works between here and there."""
    same_disk: bool

    @property
    def link(self) -> str | None:
        """What DVC takes."""
        return next((name for name in self.types if name in self.working), None)


def check_links(params: Params) -> list[Finding]:
    """DVC's cache for this working directory; params are not looked at."""
    try:
        return check_cache(read_cache(Path.cwd()))
    except ConfigError as error:
        return [missing("repository", f"DVC cannot read its {error}", "mend .dvc/config")]


def links_here() -> str | None:
    """What DVC takes in this working directory; None without DVC, or one that it cannot read."""
    try:
        cache = read_cache(Path.cwd())
    except ConfigError:
        return None
    return None if cache is None else cache.link


def check_cache(cache: Cache | None) -> list[Finding]:
    """Which links work, and whether DVC takes one."""
    if cache is None:
        return [note("repository", "no .dvc here: stages run, dvc repro does not", "dvc init")]
    works = ", ".join(cache.working) or "none"
    where = "same disk" if cache.same_disk else "another disk"
    said = f"{cache.folder} ({where}); works: {works}; takes: {cache.link or 'none'}"
    if not cache.working:
        return [note("links", f"{said}: nothing can be written there", "look at its permissions")]
    if cache.link == "copy" or cache.link is None:
        better = [name for name in LINKS[:3] if name in cache.working]
        remedy = WANTED if better else "dvc cache dir FOLDER, with a folder on this disk"
        return [note("links", f"{said}: every output lies on the disk twice", remedy)]
    return [ok("links", said)]


def read_cache(here: Path) -> Cache | None:
    """The cache of the repository that `here` lies in; None outside of one.

    Writes and removes a small file in the cache and in the repository.
    """
    root = next((one for one in (here, *here.parents) if (one / ".dvc").is_dir()), None)
    if root is None:
        return None
    section: dict[str, Any] = Config(str(root / ".dvc"))["cache"]
    folder = Path(section.get("dir") or root / ".dvc" / "cache")
    disk: Any = LocalFileSystem()
    place, beside = str(folder / "files" / "md5"), str(root / ".dvc" / "tmp" / "doctor")
    try:
        working: Sequence[Any] = try_links(list(LINKS), disk, place, disk, beside)
    except OSError:
        working = ()
    types = tuple(section.get("type") or ("reflink", "copy"))
    return Cache(folder, types, tuple(map(str, working)), _same_disk(folder, root))


def _same_disk(one: Path, other: Path) -> bool:
    while not one.exists():
        one = one.parent
    return one.stat().st_dev == other.stat().st_dev
