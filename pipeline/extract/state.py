"""What is at the three places of a store, and what a run does then: its `BuildState`, and its plan,
which is printed before anything is done.

    current   the store is of the run's plan: nothing is done
    resume    the part is of the run's plan, and as it was laid out: its missing rows are filled in
    new       a part is laid out, and its rows are filled in

A part of another plan is set aside within the new one (`pipeline.store.paths`). A run takes rows by
key from every store and build that is there, and computes the rest. A part with the same plan as
the store beside it is a repair, which lacks the damaged rows of that store.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pipeline.base.config import setting
from pipeline.base.differences import describe, differences
from pipeline.base.digests import ContentDigests
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.files import free_bytes, refuse_foreign, remove_folder
from pipeline.base.text import duration, size
from pipeline.data.episode import Embodiment
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.store import FEATURES, RowSource, StoreBuild, part_path, read_plan
from pipeline.store.border import gc_command
from pipeline.store.paths import KEPT, MERGED, builds_aside, previous_path, set_build_aside
from pipeline.store.schema import ArraySpec, read_specs

BuildState = Literal["new", "resume", "current"]
Say = Callable[[str], None]
_SHOWN = 6
"""Entries of a feature spec that a message lists."""


class StorePlaces:
    """What is at the three places of a store.

    `begun` and `finished` are the plans of the build and of the store, None where there is none.
    `aside` has the interrupted builds of other plans, `stores` the store and the previous one if
    they exist. A user's own copy in the previous store's place does not count.
    """

    def __init__(self, target: Path) -> None:
        self.target, self.part, self.previous = target, part_path(target), previous_path(target)
        self.begun, self.finished = read_plan(self.part), read_plan(target)
        self.aside = builds_aside(target)
        self.kept = KEPT.owns(self.previous) and read_plan(self.previous) is not None
        self.stores = [target] * (self.finished is not None) + [self.previous] * self.kept

    def state(self, plan: str) -> BuildState:
        """The state for a run of this plan."""
        if self.begun == plan:
            return "resume" if self.layout_damage is None else "new"
        return "current" if self.finished == plan else "new"

    @property
    def repaired(self) -> bool:
        """Whether a repair of the store has begun, in a part of its own plan."""
        plans = {self.begun, *(read_plan(place) for place in self.aside)}
        return self.finished is not None and self.finished in plans

    @property
    def known(self) -> list[Path]:
        """The builds and stores from which a build takes rows, without its own part.

        After a repair has begun, stores are left out: their damage must not come back.
        """
        return self.aside if self.repaired else [*self.aside, *self.stores]

    @cached_property
    def layout_damage(self) -> str | None:
        """What is wrong with the build, apart from its feature rows; None where nothing is."""
        with closing(self.begun_build()) as build:
            return build.layout_damage()

    def begun_build(self) -> StoreBuild:
        """The unfinished build."""
        return StoreBuild(self.target, read_specs(self.part), self.begun or "")

    def set_build_aside(self, surveyed: Survey, say: Say) -> "StorePlaces":
        """The places without the build; its rows stay known if the feature spec is the same."""
        if self.begun is not None:
            before = RowSource(self.part).attributes
            if before.feature_spec.digest == surveyed.spec.digest:
                set_build_aside(self.target)
            for line in spec_differences(before.raw["feature_spec"], surveyed.spec.attrs()):
                say(f"the unfinished build {self.part} is given up: {line}")
        return StorePlaces(self.target)

    def keeping_note(self, surveyed: Survey) -> list[str]:
        """What happens to the store and the previous one if the run lacks some of their rows.

        Raises `ConfigError` where something else lies in the previous store's place.
        """
        lost, contents, lines = self._lost(surveyed), surveyed.contents, list[str]()
        other = lost is None and self._may_have_other_rows(surveyed)
        if lost and self.finished:
            refuse_foreign(self.previous, KEPT)
            lines.append(
                f"{self.target} holds {lost}: it is kept as {self.previous} until the next "
                "successful run, which takes their rows from it where they are there again"
            )
            contents |= set(_contents(self.target) or ())
        if other:
            refuse_foreign(self.previous, KEPT)
            lines.append(
                f"{self.target} is kept as {self.previous}, and takes its place on the disk, if it "
                "holds rows that the new store lacks"
            )
        if self.kept:
            known = _contents(self.previous)
            fate = "kept" if lost else "removed"
            fate = "replaced by it" if lost and self.finished else fate
            fate = "removed, or replaced by it," if other else fate
            gone = "all its" if known is None else sum(content not in contents for content in known)
            lines.append(
                f"{self.previous} is {fate} when this run succeeds; {gone} episode(s) are only in "
                "there"
            )
        return lines

    def put_in_place(self, build: StoreBuild, surveyed: Survey, say: Say) -> None:
        """Seal a build; keep the replaced store if it has episodes or rows that the build lacks."""
        keep = self._lost(surveyed) is not None or self._has_other_rows(surveyed, self.part)
        build.seal(keep=keep)
        if keep:
            taken = size(store_bytes(read_specs(self.previous)))
            say(
                f"{self.previous}: the store before, {taken} with what both share, kept for its "
                "rows until the next run that changes the store; "
                f"{gc_command(self.previous)} removes it"
            )
        elif self.kept:
            remove_folder(self.previous, KEPT)

    def drop_previous(self, surveyed: Survey) -> None:
        """Remove a previous store that a kill left, if the store has all its episodes and rows."""
        if not self.kept or not {*(_contents(self.previous) or [""])} <= surveyed.contents:
            return
        if not _keys(self.previous) - _keys(self.target):
            remove_folder(self.previous, KEPT)

    def _may_have_other_rows(self, surveyed: Survey) -> bool:
        """Whether the store may have rows that this run does not make."""
        if self.finished in (None, surveyed.plan) or self.repaired:
            return False
        store, here = RowSource(self.target), {episode.digest for episode in surveyed.episodes}
        other_spec = store.attributes.feature_spec.digest != surveyed.spec.digest
        return other_spec or not {text.digest for text in store.texts} <= here

    def _has_other_rows(self, surveyed: Survey, build: Path) -> bool:
        """Whether the store to be replaced has rows that a complete build lacks.

        A store under repair counts as without rows: its damage must not come back.
        """
        if not self.stores or read_plan(self.stores[0]) == surveyed.plan or self.repaired:
            return False
        return bool(_keys(self.stores[0]) - _keys(build))

    def _lost(self, surveyed: Survey) -> str | None:
        """Which episodes of the existing store are not in this run; None if all are."""
        if not self.stores or read_plan(self.stores[0]) == surveyed.plan:
            return None
        if (known := _contents(self.stores[0])) is None:
            return "episodes that cannot be read any more"
        contents = surveyed.contents
        lost = sum(content not in contents for content in known)
        what = f"{lost} episode(s) that are not in this run (or whose files are read otherwise now)"
        return what if lost else None

    def refuse_to_lose(self, surveyed: Survey, embodiment: Embodiment) -> None:
        """Raise `StoreMismatch` where the run would lose rows that these params cannot make again.

        This is so for a merged store, or one under repair, with recordings that the params do not
        name: a user who follows the advice of a check may run with other params than that store's.
        It is also so for a store or build that has no episode in common with the run, and another
        embodiment or only other sources.
        """
        under_repair = self.finished is not None and self.finished == self.begun
        # The metadata of a store under repair may be damaged; its build says what it holds.
        target = None if under_repair else self.finished
        for place, plan in ((self.target, target), (self.part, self.begun)):
            if plan is not None:
                _refuse_another(RowSource(place), surveyed, embodiment)
        if not under_repair and not (self.finished or "").startswith(MERGED):
            return
        source = RowSource(self.part if under_repair else self.target)
        if lost := {text.content for text in source.texts} - surveyed.contents:
            what = "is under repair" if under_repair else "was merged of others"
            raise StoreMismatch(
                f"{self.target}: {what} and holds {len(lost)} episode(s) that the params do not "
                "name. Give the --params it was made with (or run its merge again), name another "
                "extract.store, or move it away."
            )


def row_sources(places: Sequence[Path], surveyed: Survey) -> list[RowSource]:
    """The stores and laid-out builds of the same feature spec among these."""
    digest, sources = surveyed.spec.digest, map(RowSource, places)
    return [source for source in sources if source.attributes.feature_spec.digest == digest]


def _refuse_another(source: RowSource, surveyed: Survey, embodiment: Embodiment) -> None:
    known = {text.content for text in source.texts}
    if not known or known & surveyed.contents or not source.rows:
        return
    there, here = source.attributes.sources, sorted({r.source for r in surveyed.recordings})
    streams, now = source.attributes.raw["streams"], embodiment.document()
    both = [name for name in now if streams[name]["names"] and now[name]["names"]]
    apart = differences({name: streams[name] for name in both}, {name: now[name] for name in both})
    differing = [f"; {line}" for line in describe(apart)]
    if differing or not set(there) & set(here):
        raise StoreMismatch(
            f"{source.path}: holds the feature rows of {len(known)} episode(s), none of which is "
            "in data.sources, and extraction would throw them away (sources: "
            f"{', '.join(there)} there, {', '.join(here)} here{''.join(differing)}).\n"
            "Name another extract.store, give the --params it was made with, or move it away."
        )


def _contents(store: Path) -> list[str] | None:
    """The content digest of each episode; None where they can no longer be read."""
    try:
        return [text.content for text in RowSource(store).texts]
    except StoreIncomplete:
        return None


def _keys(store: Path) -> set[bytes]:
    """The key of each row of a store or a build; none where they can no longer be read."""
    try:
        return set(RowSource(store).rows)
    except StoreIncomplete:
        return set()


def spec_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """How two feature specs differ, without the entries that follow from other entries."""
    differing = differences(before, now)
    first = {
        place: values
        for place, values in differing.items()
        if not place.startswith(("slots", "example_prompt"))
    }
    return describe(first or differing)[:_SHOWN]


def plan_lines(
    build: StoreBuild,
    surveyed: Survey,
    digests: ContentDigests,
    places: StorePlaces,
    state: BuildState,
    sources: Sequence[RowSource],
    known: int,
) -> list[str]:
    """What the extraction will do, line by line; `known` rows need no model.

    `sources` are stores and builds of the same feature spec.
    """
    known_digests = {text.digest for source in sources for text in source.texts}
    unchanged = sum(episode.digest in known_digests for episode in surveyed.episodes)
    begun = places.begun == surveyed.plan
    place = places.part if begun or places.repaired else places.target
    before = None if read_plan(place) is None else RowSource(place)
    if state == "resume":
        doing = "completing the repair" if places.repaired else "continuing the interrupted build"
        reasons = [f"{doing} {places.part}"]
    elif begun:
        reasons = [f"{places.layout_damage}; streams are laid out again, the feature rows are kept"]
    else:
        reasons = _reasons(surveyed, before)
    rows, variants = build.specs[FEATURES].shape[0], surveyed.spec.variants
    left, rows_per_s = rows - known, digests.rate(surveyed.rate_name)
    if not left:
        time = "none, the model is not needed"
    elif rows_per_s is None:
        time = "not known before a first session of this store with this model and device"
    else:
        time = f"about {duration(left / rows_per_s)} at {rows_per_s:.1f} rows/s, as last measured"
    needed, free = size(store_bytes(build.specs)), size(free_bytes(build.part))
    return [
        *(f"WARNING: {warning}" for warning in _warnings(surveyed, before, left)),
        *(f"why: {reason}" for reason in reasons),
        f"episodes: {len(surveyed.episodes)}, {unchanged} of them unchanged",
        f"rows: {rows}, {known} known, {left} to compute"
        + (f" in {variants} variants each" if left and variants > 1 else "")
        + (" (fewer where a key turns out to be known)" if left and known else ""),
        f"disk: {needed} for the whole store, {free} free",
        f"time: {time}",
        *places.keeping_note(surveyed),
    ]


def store_bytes(specs: dict[str, ArraySpec]) -> int:
    """Bytes of all rows of a store."""
    return sum(spec.data_bytes for spec in specs.values())


def _reasons(surveyed: Survey, before: RowSource | None) -> Iterator[str]:
    """Why the existing store, if any, is not enough."""
    if before is None:
        yield "there is no store yet"
        return
    lines = spec_differences(before.attributes.raw["feature_spec"], surveyed.spec.attrs())
    yield from (f"feature spec, {line}" for line in lines)
    digests = {text.digest for text in before.texts}
    changed = [episode for episode in surveyed.episodes if episode.digest not in digests]
    here = {episode.digest for episode in surveyed.episodes}
    revised = {episode.content for episode in changed}  # these count as changed
    gone = sum(text.digest not in here and text.content not in revised for text in before.texts)
    if changed:
        what = "files, how these are read, instruction, name, place, action_hz or vlm_reuse_count"
        yield f"{len(changed)} episode(s) are new or have other {what}"
    if gone:
        yield f"{gone} episode(s) of the store are gone or changed"
    if unrated := before.attributes.action_hz is None:
        yield "the store does not say the rate of its ticks"
    if not (lines or changed or gone or unrated):
        yield "extract.sensor_dtype, the order of episodes or how actions are derived changed"


def _warnings(surveyed: Survey, before: RowSource | None, missing: int) -> Iterator[str]:
    """What the user may not intend, each with what to do about it."""
    data, vlm, extract = surveyed.data, surveyed.vlm, surveyed.extract
    recordings, views = surveyed.recordings, surveyed.spec.views
    known = before.attributes.feature_spec.views if before else []
    if known and (added := set(views) - set(known)):
        count = sum(not added.isdisjoint(recording.view_names()) for recording in recordings)
        kept = setting("data.views", [view for view in known if view in views])
        yield (
            f"{count} of {len(recordings)} episode(s) have {', '.join(sorted(added))}, which the "
            "store does not have. The model sees all views of a store at a time, so that every row "
            f"of every episode is computed again. To keep the rows: {kept}"
        )
    if not views and data.views != ():
        yield (
            f"none of the {len(recordings)} episode(s) has a frame, so that every row will hold "
            "the features of the instruction alone. Check data.views and the folders of images. "
            "To say that it is meant: --set data.views=[]"
        )
    without = [recording.source for recording in recordings if not recording.has_poses]
    if data.action_rotation == "auto" and 0 < len(without) < len(recordings):
        yield (
            f"{len(without)} of {len(recordings)} episode(s), of source(s) "
            f"{', '.join(dict.fromkeys(without))}, have no poses, so that the actions of all are "
            "euler_delta in place of rotvec. To keep rotvec: give these a store of their own. To "
            "say that it is meant: --set data.action_rotation=euler_delta"
        )
    # The devices of the workers of a dask scheduler are not known.
    if missing and vlm.dtype != "float32" and isinstance(extract.workers, int):
        from pipeline.base.machine import resolve_device

        if resolve_device(extract.device).type == "cpu":
            yield (
                f"the model will run on the CPU in vlm.dtype {vlm.dtype}, which many CPUs "
                "only emulate, slowly. Set vlm.dtype=float32, or extract on a GPU, before the "
                "first long run: no row is taken over by another dtype"
            )


def count_known(
    checked: Sequence[CheckedEpisode], surveyed: Survey, sources: Sequence[RowSource]
) -> int:
    """How many rows of these episodes are in `sources`, by content, instruction and frame times."""
    count = 0
    for episode in checked:
        identity = episode.fields["content"], episode.fields["instruction"]
        times = set().union(*(source.keys_of(*identity) for source in sources))
        rows = episode.ticks.frame_times(surveyed.spec.views)
        count += sum(row.tobytes() in times for row in rows)
    return count
