"""What is at the three places of a store, and what a run does then: its `BuildState`, and its plan,
which is printed before anything is done.

    current   the store is of the run's plan: nothing is done
    resume    the part is of the run's plan, and as it was laid out: its missing rows are filled in
    new       a part is laid out, and its rows are filled in

A part of another plan is set aside within the new one (`pipeline.store.paths`). A run takes rows by
key from every store and build that is there, and computes the rest. So a repair is a new build of
the store's own plan: whatever is damaged is not taken.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pipeline.base.config import PCA
from pipeline.base.differences import describe, differences
from pipeline.base.digests import ContentDigests
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.files import free_bytes, refuse_foreign, remove_folder
from pipeline.base.text import duration, size
from pipeline.data.episode import Embodiment
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.store import FEATURES, RowSource, StoreBuild, part_path, read_plan
from pipeline.store.documents import gc_command
from pipeline.store.paths import KEPT, MERGED, builds_aside, previous_path, set_build_aside
from pipeline.store.schema import ArraySpec, read_specs

BuildState = Literal["new", "resume", "current"]
Say = Callable[[str], None]
_SHOWN = 6
"""Entries of a feature spec that a message lists."""


class StorePlaces:
    """What is at the three places of a store.

    `begun` and `finished` are the plans of the build and of the store, None where there is none.
    `known` has the interrupted builds of other plans, then `stores`: the store and the previous one
    if they exist. A user's own copy in the previous store's place does not count.
    """

    def __init__(self, target: Path) -> None:
        self.target, self.part, self.previous = target, part_path(target), previous_path(target)
        self.begun, self.finished = read_plan(self.part), read_plan(target)
        self.kept = KEPT.owns(self.previous) and read_plan(self.previous) is not None
        self.stores = [target] * (self.finished is not None) + [self.previous] * self.kept
        self.known = [*builds_aside(target), *self.stores]

    def state(self, plan: str, repair: bool = False) -> BuildState:
        """The state for a run of this plan; a `repair` makes the store of this plan again."""
        if self.begun == plan:
            return "resume" if self.layout_damage is None else "new"
        return "current" if self.finished == plan and not repair else "new"

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

    def keeping_note(self, surveyed: Survey) -> Iterator[str]:
        """What happens to the store and the previous one.

        Raises `ConfigError` where the store must be kept and something else lies in the previous
        store's place.
        """
        if self.finished not in (None, surveyed.plan):
            if lost := len(_contents(self.target) - surveyed.contents):
                refuse_foreign(self.previous, KEPT)
                yield f"{self.target} holds {lost} episode(s) that are not in this run"
            yield (
                f"{self.target} is kept as {self.previous} until the next successful run, if it "
                "holds episodes or rows that the new store lacks"
            )
        if self.kept:
            only = len(_contents(self.previous) - surveyed.contents)
            yield (
                f"{self.previous} is removed or replaced when this run succeeds; it holds {only} "
                "episode(s) that are not in this run"
            )

    def put_in_place(self, build: StoreBuild, surveyed: Survey, say: Say) -> None:
        """Seal a build; keep the replaced store if it has episodes or rows that the build lacks."""
        keep = self._has_more(surveyed)
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

    def _has_more(self, surveyed: Survey) -> bool:
        """Whether the store to be replaced has episodes or rows that a complete build lacks.

        One that cannot be read counts as such. One behind a link is not removed anyway.
        """
        if not self.stores or self.finished == surveyed.plan or self.target.is_symlink():
            return False
        try:
            before = RowSource(self.stores[0])
            lost = {text.content for text in before.texts} - surveyed.contents
            return bool(lost or before.rows.keys() - RowSource(self.part).rows.keys())
        except StoreIncomplete:
            return True

    def refuse_to_lose(self, surveyed: Survey, embodiment: Embodiment) -> None:
        """Raise `StoreMismatch` where the run would lose rows that these params cannot make again.

        This is so for a merged store with recordings that the params do not name: a user who
        follows the advice of a check may run with other params than that store's. It is also so for
        a store or build that has no episode in common with the run, and another embodiment or only
        other sources.
        """
        for place, plan in ((self.target, self.finished), (self.part, self.begun)):
            if plan not in (None, surveyed.plan):
                _refuse_another(RowSource(place), surveyed, embodiment)
        merged = (self.finished or "").startswith(MERGED)
        if merged and (lost := _contents(self.target) - surveyed.contents):
            raise StoreMismatch(
                f"{self.target}: was merged of others and holds {len(lost)} episode(s) that the "
                "params do not name. Name another extract.store, or move it away."
            )


def row_sources(places: Sequence[Path], surveyed: Survey) -> list[RowSource]:
    """The stores and laid-out builds of the same feature spec among these.

    A store of the run's own plan is under repair: damage in it only keeps rows from being taken.
    """
    sources: list[RowSource] = []
    for path in places:
        is_target = path.absolute() == surveyed.target.absolute()  # workers have absolute paths
        damaged = is_target and read_plan(path) == surveyed.plan
        try:
            source = RowSource(path, damaged=damaged)
        except StoreIncomplete:
            if not damaged:
                raise
            continue
        if source.attributes.feature_spec.digest == surveyed.spec.digest:
            sources.append(source)
    return sources


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


def _contents(store: Path) -> set[str]:
    """The content digests of the episodes; none where they can no longer be read."""
    try:
        return {text.content for text in RowSource(store).texts}
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
    known: int,
) -> list[str]:
    """What the extraction will do, line by line; `known` rows need no model."""
    before = None
    if state == "resume":
        reasons = [f"continuing the interrupted build {places.part}"]
    elif places.begun == surveyed.plan:
        reasons = [f"{places.layout_damage}; streams are laid out again, the feature rows are kept"]
    elif places.finished == surveyed.plan:
        reasons = ["the store is damaged; its sound feature rows are kept"]
    elif places.finished is None:
        reasons = ["there is no store yet"]
    else:
        before = RowSource(places.target)
        reasons = [*_reasons(surveyed, before)]
    rows, variants = build.specs[FEATURES].shape[0], surveyed.spec.variants
    left, rows_per_s = rows - known, digests.rate(surveyed.rate_name)
    if not left:
        time = "none, the model is not needed"
    elif rows_per_s is None:
        time = "not known before a first session of this store with this model and device"
    else:
        time = f"about {duration(left / rows_per_s)} at {rows_per_s:.1f} rows/s, as last measured"
    needed, free = size(store_bytes(build.specs)), size(free_bytes(build.part))
    if surveyed.spec.basis is not None and state == "new":
        reasons.append(_basis_line(surveyed))
    return [
        *(f"WARNING: {warning}" for warning in _warnings(surveyed)),
        *(f"why: {reason}" for reason in reasons),
        f"episodes: {len(surveyed.episodes)}",
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


def _basis_line(surveyed: Survey) -> str:
    """Whose basis a new build takes."""
    dtype = surveyed.extract.dtype
    if isinstance(dtype, PCA) and dtype.basis is not None:
        return f"the basis of {dtype.basis} is taken"
    return "the basis of the store or build there is kept, so that its rows stay known"


def _reasons(surveyed: Survey, before: RowSource) -> Iterator[str]:
    """Why the existing store is not enough."""
    lines = spec_differences(before.attributes.raw["feature_spec"], surveyed.spec.attrs())
    yield from (f"feature spec, {line}" for line in lines)
    here, there = ({it.digest for it in episodes} for episodes in (surveyed.episodes, before.texts))
    if added := len(here - there):
        what = "files, how these are read, instruction, name, place, action_hz or vlm_reuse_count"
        yield f"{added} episode(s) are new or have other {what}"
    if gone := len({text.content for text in before.texts} - surveyed.contents):
        yield f"{gone} episode(s) of the store are gone"
    if not (lines or added or gone):
        yield "extract.sensor_dtype, action_hz, the order of episodes or their actions changed"


def _warnings(surveyed: Survey) -> Iterator[str]:
    """What the user may not intend, each with what to do about it."""
    data = surveyed.data
    recordings, views = surveyed.recordings, surveyed.spec.views
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
