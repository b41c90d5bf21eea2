"""What lies at the place of a store and beside it, and what of that an extraction may use."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from pipeline.errors import StoreMismatch
from pipeline.extraction.survey import Survey
from pipeline.ownership import remove_folder
from pipeline.store import Donor, part_path, read_plan
from pipeline.store.places import MERGED, STORE
from pipeline.vlm.feature_spec import differences

Say = Callable[[str], None]


def plans(target: Path) -> tuple[str | None, str | None]:
    """Of the unfinished build, and of the store."""
    return read_plan(part_path(target)), read_plan(target)


def known_places(target: Path) -> list[Path]:
    """Builds that were set aside, and the store, unless a repair of it has begun.

    A repair leaves out what is damaged: that must not come back from the store that it mends.
    """
    aside = set_aside(target)
    repairs = {read_plan(place) for place in [*aside, part_path(target)]} - {None}
    return aside if read_plan(target) in repairs else [*aside, target]


@contextmanager
def donors_at(places: Sequence[Path], surveyed: Survey) -> Generator[list[Donor]]:
    """Stores and laid-out builds of the same feature spec among these places."""
    donors = [Donor(place) for place in places if read_plan(place) is not None]
    try:
        yield [donor for donor in donors if donor.spec_digest == surveyed.spec.digest]
    finally:
        for donor in donors:
            donor.close()


def refuse_to_lose(target: Path, surveyed: Survey) -> None:
    """Raise where a merged store, or one under repair, holds recordings that params do not name.

    Who follows the advice of a check may run under other params than that store's own.
    """
    begun, there = plans(target)
    if there is None or not (begun == there or there.startswith(MERGED)):
        return
    with closing(Donor(part_path(target) if begun == there else target)) as donor:
        lost = set(donor.episode_contents) - {one.content for one in surveyed.episodes}
    if lost:
        what = "is under repair" if begun == there else "was merged of others"
        raise StoreMismatch(
            f"{target}: {what} and holds {len(lost)} episode(s) that the params do not name; "
            "extraction would replace it. Give the --params it was made with (or run its merge "
            "again), name another extract.store, or move it away."
        )


def make_room(target: Path, surveyed: Survey, say: Say) -> None:
    """Set an unfinished build of another plan aside; of another feature spec, it is of no use."""
    part = part_path(target)
    if read_plan(part) is None:
        return
    abandoned = Donor(part)
    abandoned.close()
    if abandoned.spec_digest == surveyed.spec.digest:
        taken = len(set_aside(target))
        while (aside := _beside(target, f".known-{taken}")).exists():
            taken += 1
        part.rename(aside)
        return
    for line in differences(abandoned.attrs["feature_spec"], surveyed.spec.attrs()):
        say(f"the unfinished build {part} is given up: {line}")


def set_aside(target: Path) -> list[Path]:
    """Builds of other plans that were interrupted, kept for their rows."""
    return sorted(target.parent.glob(f"{target.name}.known-*"))


def remove(folders: Sequence[Path]) -> None:
    """Remove what has been taken over."""
    for folder in folders:
        remove_folder(folder, STORE)


def ledger_path(target: Path) -> Path:
    """Where the digests of files are remembered."""
    return _beside(target, ".files.sqlite")


def _beside(target: Path, suffix: str) -> Path:
    return target.with_name(target.name + suffix)
