"""What lies at the place of a store and beside it, and what of that an extraction may use."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

from pipeline.base.differences import describe, differences
from pipeline.base.durable import KEPT, previous_path
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.ownership import refuse_foreign, remove_folder
from pipeline.data.embodiment import Embodiment
from pipeline.extract.survey import Survey
from pipeline.store import RowSource, StoreBuild, part_path, read_plan
from pipeline.store.paths import MERGED, STORE, is_store
from pipeline.store.schema import read_specs

Say = Callable[[str], None]
# Entries of a feature spec that a message lists.
_SHOWN = 6


class StorePlaces:
    """A store, its unfinished build and what earlier runs left of it; plans as they were found.

    `begun` and `finished` are the plans of the build and of the store, None where there is none.
    `aside` are builds of other plans that were interrupted, kept for their rows, and `kept` is the
    store that a run kept, if there is one: a copy that a user made is not one.
    """

    def __init__(self, target: Path) -> None:
        self.target, self.part, self.previous = target, part_path(target), previous_path(target)
        self.begun, self.finished = read_plan(self.part), read_plan(target)
        self.aside = [
            path
            for path in sorted(target.parent.glob(f"{target.name}.known-*"))
            if path.name.rpartition("-")[2].isdigit() and is_store(path)
        ]
        is_kept = KEPT.owns(self.previous) and read_plan(self.previous) is not None
        self.kept = [self.previous] if is_kept else []

    @property
    def known(self) -> list[Path]:
        """Builds that were set aside, the store, and the one before it, unless a repair has begun.

        A repair leaves out what is damaged: that must not come back from the store that it mends.
        """
        store = [] if self.finished is None else [self.target]
        return self.aside if self.repaired else [*self.aside, *store, *self.kept]

    @property
    def repaired(self) -> bool:
        """Whether a build of the store's own plan has begun."""
        repairs = {self.begun, *(read_plan(place) for place in self.aside)}
        return self.finished is not None and self.finished in repairs

    def stands(self, surveyed: Survey) -> bool:
        """Whether a store or a build of this very plan is there; a build, as it was laid out."""
        if self.begun == surveyed.plan:
            return self.layout_damage is None
        return self.finished == surveyed.plan

    def begun_build(self) -> StoreBuild:
        """The unfinished build."""
        return StoreBuild(self.target, read_specs(self.part), self.begun or "")

    @cached_property
    def layout_damage(self) -> str | None:
        """What is wrong with all but the feature rows of the unfinished build."""
        with closing(self.begun_build()) as build:
            return build.layout_damage()

    def make_room(self, surveyed: Survey, say: Say) -> None:
        """Set an unfinished build aside; of another feature spec, it is of no use."""
        if self.begun is None:
            return
        before = RowSource(self.part).attrs["feature_spec"]
        if before["digest"] != surveyed.spec.digest:
            for line in spec_differences(before, surveyed.spec.attrs()):
                say(f"the unfinished build {self.part} is given up: {line}")
            return
        names = (self.target.with_name(f"{self.target.name}.known-{n}") for n in count())
        self.part.rename(next(path for path in names if not path.exists()))

    def keeping_note(self, surveyed: Survey) -> list[str]:
        """What a run says of episodes that it does not name: the store with them is kept once more.

        Raises `ConfigError` where something else lies where it would be kept.
        """
        lost, contents, lines = self._lost(surveyed), surveyed.contents, list[str]()
        if lost:
            refuse_foreign(self.previous, KEPT)
            lines.append(
                f"{self.target} holds {lost}: it is kept as {self.previous} until the next "
                "successful run, which takes their rows from it where they are there again"
            )
            contents |= set(_contents(self.target) or ())
        for place in self.kept:
            known, then = _contents(place), "replaced by it" if lost else "removed"
            gone = "all its" if known is None else sum(one not in contents for one in known)
            lines.append(
                f"{place} is {then} when this run succeeds; {gone} episode(s) are only in there"
            )
        return lines

    def put_in_place(self, build: StoreBuild, surveyed: Survey, say: Say) -> None:
        """Seal a build, keep the store before it where episodes would be lost, and tidy up."""
        build.keeps_replaced = self._lost(surveyed) is not None
        with closing(build):
            build.seal()
        for folder in self.aside:
            remove_folder(folder, STORE)
        if build.keeps_replaced:
            say(f"{self.previous}: the store of before, kept until the next successful run")
        else:
            for place in self.kept:
                remove_folder(place, KEPT)

    def _lost(self, surveyed: Survey) -> str | None:
        """Which episodes of the store are not in the one that takes its place; None: all are."""
        if self.finished in (None, surveyed.plan):
            return None
        if (known := _contents(self.target)) is None:
            return "episodes that can no longer be told"
        contents = surveyed.contents
        lost = sum(content not in contents for content in known)
        what = f"{lost} episode(s) that are not in this run (or whose files are read otherwise now)"
        return what if lost else None

    def refuse_to_lose(self, surveyed: Survey, embodiment: Embodiment) -> None:
        """Raise `StoreMismatch` where rows would be lost that these params cannot give again.

        Those of a merged store, or one under repair, with recordings that params do not name: who
        follows the advice of a check may run under other params than that store's own. And those of
        a store or build without an episode in common, of another embodiment or other sources only.
        """
        for place, plan in ((self.target, self.finished), (self.part, self.begun)):
            if plan is not None:
                _refuse_another(RowSource(place), surveyed, embodiment)
        under_repair = self.finished is not None and self.finished == self.begun
        if not under_repair and not (self.finished or "").startswith(MERGED):
            return
        source = RowSource(self.part if under_repair else self.target)
        if lost := set(source.episode_contents) - surveyed.contents:
            what = "is under repair" if under_repair else "was merged of others"
            raise StoreMismatch(
                f"{self.target}: {what} and holds {len(lost)} episode(s) that the params do not "
                "name; extraction would replace it. Give the --params it was made with (or run its "
                "merge again), name another extract.store, or move it away."
            )


def row_sources(places: Sequence[Path], surveyed: Survey) -> list[RowSource]:
    """The stores and laid-out builds of the same feature spec among these."""
    sources = map(RowSource, places)
    return [source for source in sources if source.spec_digest == surveyed.spec.digest]


def _refuse_another(source: RowSource, surveyed: Survey, embodiment: Embodiment) -> None:
    known = set(source.episode_contents)
    if not known or known & surveyed.contents or not source.rows:
        return
    there, here = source.attrs["sources"], sorted({r.source for r in surveyed.recordings})
    before, now = source.attrs["streams"], embodiment.document()
    differing = [
        f"; {stream}: {_channels(before[stream])} there, {_channels(now[stream])} here"
        for stream in ("action", "sensor", "state")
        if before[stream]["names"] and now[stream]["names"]
        if any(before[stream][key] != now[stream][key] for key in ("names", "units"))
    ]
    if differing or not set(there) & set(here):
        raise StoreMismatch(
            f"{source.path}: holds the feature rows of {len(known)} episode(s), none "
            "of which is in data.sources, and extraction would throw them away (sources: "
            f"{', '.join(there)} there, {', '.join(here)} here{''.join(differing)}).\n"
            "Name another store for these recordings, with --set extract.store=…, give the "
            "--params it was made with, or move it away."
        )


def _channels(stream: Mapping[str, Any]) -> str:
    names, units = stream["names"], ", ".join(sorted(set(stream["units"])))
    return f"{len(names)} channels [{names[0]} … {names[-1]}] ({units})"


def _contents(store: Path) -> list[str] | None:
    """The content digest of each episode; None where they can no longer be read."""
    try:
        return RowSource(store).episode_contents
    except StoreIncomplete:
        return None


def spec_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What differs between two feature specs, without all that follows from it."""
    differing = differences(before, now)
    first = {
        place: values
        for place, values in differing.items()
        if not place.startswith(("slots", "example_prompt"))
    }
    lines = describe(first or differing)[:_SHOWN]
    more = len(differing) - len(lines)
    return [*lines, *([f"{more} more entries, most of which follow from that"] if more else [])]
