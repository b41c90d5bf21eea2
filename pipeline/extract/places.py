"""What lies at the place of a store and beside it, and what of that an extraction may use."""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from pipeline.base.durable import KEPT, previous_path
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.ownership import refuse_foreign, remove_folder
from pipeline.data.embodiment import Embodiment
from pipeline.extract.plan import spec_differences
from pipeline.extract.survey import Survey
from pipeline.store import RowSource, StoreBuild, part_path, read_plan
from pipeline.store.paths import MERGED, STORE, is_store
from pipeline.store.schema import read_specs

Say = Callable[[str], None]
_SHOWN = 6
"""Channels that a message lists."""


def plans(target: Path) -> tuple[str | None, str | None]:
    """Of the unfinished build, and of the store."""
    return read_plan(part_path(target)), read_plan(target)


def layout_damage(target: Path) -> str | None:
    """What is wrong with all but the feature rows of the build of a store."""
    part = part_path(target)
    with closing(StoreBuild(target, read_specs(part), read_plan(part) or "")) as build:
        return build.layout_damage()


def known_places(target: Path) -> list[Path]:
    """Builds that were set aside, the store, and the one before it, unless a repair has begun.

    A repair leaves out what is damaged: that must not come back from the store that it mends.
    """
    aside = set_aside(target)
    repairs = {read_plan(place) for place in [*aside, part_path(target)]} - {None}
    return aside if read_plan(target) in repairs else [*aside, target, *_kept(target)]


@contextmanager
def donors_at(places: Sequence[Path], surveyed: Survey) -> Generator[list[RowSource]]:
    """Stores and laid-out builds of the same feature spec among these places."""
    donors = [RowSource(place) for place in places if read_plan(place) is not None]
    try:
        yield [donor for donor in donors if donor.spec_digest == surveyed.spec.digest]
    finally:
        for donor in donors:
            donor.close()


def refuse_to_lose(target: Path, surveyed: Survey, embodiment: Embodiment) -> None:
    """Raise `StoreMismatch` where rows would be lost that these params cannot give again.

    Those of a merged store, or one under repair, with recordings that params do not name: who
    follows the advice of a check may run under other params than that store's own. And those of a
    store or build without an episode in common, of another embodiment or of other sources only.
    """
    begun, finished = plans(target)
    for place in (target, part_path(target)):
        if read_plan(place) is not None:
            with closing(RowSource(place)) as donor:
                _refuse_another(donor, surveyed, embodiment)
    if finished is None or not (begun == finished or finished.startswith(MERGED)):
        return
    with closing(RowSource(part_path(target) if begun == finished else target)) as donor:
        lost = set(donor.episode_contents) - {one.content for one in surveyed.episodes}
    if lost:
        what = "is under repair" if begun == finished else "was merged of others"
        raise StoreMismatch(
            f"{target}: {what} and holds {len(lost)} episode(s) that the params do not name; "
            "extraction would replace it. Give the --params it was made with (or run its merge "
            "again), name another extract.store, or move it away."
        )


def _refuse_another(donor: RowSource, surveyed: Survey, embodiment: Embodiment) -> None:
    known, now = set(donor.episode_contents), {one.content for one in surveyed.episodes}
    if not known or known & now or not donor.rows:
        return
    sources = donor.attrs["sources"], sorted({one.recording.source for one in surveyed.episodes})
    before, now = donor.attrs["streams"], embodiment.document()
    differing = [
        f"{stream}: {_channels(before[stream])} there, {_channels(now[stream])} here"
        for stream in ("action", "sensor", "state")
        if before[stream]["names"] and now[stream]["names"]
        if any(before[stream][key] != now[stream][key] for key in ("names", "units"))
    ]
    if differing or not set(sources[0]) & set(sources[1]):
        why = [f"sources: {', '.join(sources[0])} there, {', '.join(sources[1])} here", *differing]
        raise StoreMismatch(
            f"{donor.path}: holds the feature rows of {len(known)} episode(s), none "
            "of which is in data.sources, and extraction would throw them away:\n"
            + "\n".join(f"  {line}" for line in why)
            + "\nName another store for these recordings, with --set extract.store=…, give the "
            "--params it was made with, or move it away."
        )


def _channels(stream: Mapping[str, Any]) -> str:
    pairs = zip(stream["names"], stream["units"], strict=True)
    named = [f"{name} ({unit})" if unit else name for name, unit in pairs]
    listed = ", ".join(named if len(named) <= _SHOWN else [*named[: _SHOWN - 1], "…"])
    return f"{len(named)} channels [{listed}]"


def keeping_note(target: Path, surveyed: Survey) -> list[str]:
    """What a run says of episodes that it does not name: the store with them is kept once more.

    Raises `ConfigError` where something else lies where it would be kept.
    """
    kept, lines = previous_path(target), list[str]()
    contents = {one.content for one in surveyed.episodes}
    if lost := _lost(target, surveyed):
        refuse_foreign(kept, KEPT)
        lines = [
            f"{target} holds {lost}: it is kept as {kept} until the next successful run, which "
            "takes their rows from it where they are there again"
        ]
        contents |= set(_contents(target) or ())
    for place in _kept(target):
        known = _contents(place)
        gone = "all its" if known is None else sum(content not in contents for content in known)
        then = "replaced by it" if lost else "removed"
        lines.append(
            f"{place} is {then} when this run succeeds; {gone} episode(s) are only in there"
        )
    return lines


def put_in_place(build: StoreBuild, surveyed: Survey, say: Say) -> None:
    """Seal a build, keep the store before it where episodes would be lost, and tidy up."""
    target = build.target
    build.keeps_replaced = _lost(target, surveyed) is not None
    with closing(build):
        build.seal()
    for folder in set_aside(target):
        remove_folder(folder, STORE)
    if build.keeps_replaced:
        say(f"{previous_path(target)}: the store of before, kept until the next successful run")
    else:
        for place in _kept(target):
            remove_folder(place, KEPT)


def _lost(target: Path, surveyed: Survey) -> str | None:
    """Which episodes of the store are not in the one that takes its place; None where all are."""
    if read_plan(target) in (None, surveyed.plan):
        return None
    if (known := _contents(target)) is None:
        return "episodes that can no longer be told"
    contents = {one.content for one in surveyed.episodes}
    lost = sum(content not in contents for content in known)
    named = f"{lost} episode(s) that are not in this run (or whose files are read otherwise now)"
    return named if lost else None


def _contents(store: Path) -> list[str] | None:
    """The content digest of each episode; None where they can no longer be read."""
    with closing(RowSource(store)) as donor:
        try:
            return donor.episode_contents
        except StoreIncomplete:
            return None


def _kept(target: Path) -> list[Path]:
    """The store that a run kept, if there is one; a copy that a user made is not one."""
    kept = previous_path(target)
    return [kept] if KEPT.owns(kept) and read_plan(kept) is not None else []


def make_room(target: Path, surveyed: Survey, say: Say) -> None:
    """Set an unfinished build of another plan aside; of another feature spec, it is of no use."""
    part = part_path(target)
    if read_plan(part) is None:
        return
    abandoned = RowSource(part)
    abandoned.close()
    if abandoned.spec_digest == surveyed.spec.digest:
        taken = len(set_aside(target))
        while (aside := _beside(target, f".known-{taken}")).exists():
            taken += 1
        part.rename(aside)
        return
    for line in spec_differences(abandoned.attrs["feature_spec"], surveyed.spec.attrs()):
        say(f"the unfinished build {part} is given up: {line}")


def set_aside(target: Path) -> list[Path]:
    """Builds of other plans that were interrupted, kept for their rows."""
    builds = sorted(target.parent.glob(f"{target.name}.known-*"))
    return [path for path in builds if path.name.rpartition("-")[2].isdigit() and is_store(path)]


def ledger_path(target: Path) -> Path:
    """Where the digests of files are remembered."""
    return _beside(target, ".files.sqlite")


def _beside(target: Path, suffix: str) -> Path:
    return target.with_name(target.name + suffix)
