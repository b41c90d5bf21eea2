"""What an extraction would do, and why; said before anything is done.

`StorePlaces` is what lies at the place of a store and beside it, and what of that may be used.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.base.config import setting
from pipeline.base.differences import describe, differences
from pipeline.base.digests import ContentDigests, joint_digest
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.files import free_bytes, refuse_foreign, remove_folder
from pipeline.base.format import duration, size
from pipeline.data.embodiment import Embodiment
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.store import FEATURES, RowSource, StoreBuild, part_path, read_plan
from pipeline.store.paths import KEPT, MERGED, builds_aside, previous_path, set_build_aside
from pipeline.store.schema import ArraySpec, read_specs

Say = Callable[[str], None]
_DECIDES_SPEED = ("weights", "adapter", "processor", "compute_dtype", "variants")

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
        self.aside = builds_aside(target)
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
        before = RowSource(self.part).said
        if before.feature_spec.digest != surveyed.spec.digest:
            for line in spec_differences(before.raw["feature_spec"], surveyed.spec.attrs()):
                say(f"the unfinished build {self.part} is given up: {line}")
            return
        set_build_aside(self.target)

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
        keep = self._lost(surveyed) is not None
        with closing(build):
            build.seal(keep=keep)
        if keep:
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
        under_repair = self.finished is not None and self.finished == self.begun
        # A store under repair may be one whose metadata are damaged: its build says what it holds.
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
    return [source for source in sources if source.said.feature_spec.digest == digest]


def _refuse_another(source: RowSource, surveyed: Survey, embodiment: Embodiment) -> None:
    known = {text.content for text in source.texts}
    if not known or known & surveyed.contents or not source.rows:
        return
    there, here = source.said.sources, sorted({r.source for r in surveyed.recordings})
    streams, now = source.said.raw["streams"], embodiment.document()
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


def spec_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What differs between two feature specs, without all that follows from it."""
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
    sources: Sequence[RowSource],
    known: int,
) -> list[str]:
    """What there is to do, for people, where so many rows are known.

    `sources` are stores and builds of the same feature spec.
    """
    there = {text.digest for source in sources for text in source.texts}
    unchanged = sum(episode.digest in there for episode in surveyed.episodes)
    resumes = places.begun == surveyed.plan
    place = places.part if resumes or places.repaired else places.target
    before = None if read_plan(place) is None else RowSource(place)
    if resumes and places.layout_damage:
        reasons = [f"{places.layout_damage}; streams are laid out again, the feature rows are kept"]
    elif resumes:
        repairs = places.finished == surveyed.plan
        doing = "completing the repair" if repairs else "continuing the interrupted build"
        reasons = [f"{doing} {places.part}"]
    else:
        reasons = _reasons(surveyed, before, build.specs)
    rows, variants = build.specs[FEATURES].shape[0], surveyed.spec.variants
    left, rows_per_s = rows - known, digests.rate(rate_name(surveyed))
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


def rate_name(surveyed: Survey) -> str:
    """Under which name the speed of this model on these devices is remembered.

    Whatever else of the spec changes, such as prompt, slots or names of views, costs little.
    """
    extract, spec = surveyed.params.extract, surveyed.spec.attrs()
    by = f" on {extract.workers}" if extract.workers != 0 else ""
    alike = {name: spec.get(name) for name in _DECIDES_SPEED} | {"views": len(spec["views"])}
    return f"{joint_digest(json.dumps(alike, sort_keys=True))} {extract.device}{by}"


def store_bytes(specs: dict[str, ArraySpec]) -> int:
    """Bytes that a store's rows take."""
    return sum(spec.data_bytes for spec in specs.values())


def _reasons(
    surveyed: Survey, before: RowSource | None, specs: dict[str, ArraySpec]
) -> Iterator[str]:
    """Why the store that is there, if any, will not do."""
    if before is None:
        yield "there is no store yet"
        return
    lines = spec_differences(before.said.raw["feature_spec"], surveyed.spec.attrs())
    yield from (f"feature spec, {line}" for line in lines)
    digests = {text.digest for text in before.texts}
    changed = [episode for episode in surveyed.episodes if episode.digest not in digests]
    here = {episode.digest for episode in surveyed.episodes}
    again = {episode.content for episode in changed}  # said as the new ones are
    gone = sum(text.digest not in here and text.content not in again for text in before.texts)
    if changed:
        what = "files, how these are read, instruction, name, place, action_hz or vlm_reuse_count"
        yield f"{len(changed)} episode(s) are new or have other {what}"
    if gone:
        yield f"{gone} episode(s) of the store are gone or changed"
    dtypes = [
        f"{name} was {before.specs[name].dtype}, is to be {spec.dtype}"
        for name, spec in specs.items()
        if name != FEATURES and before.specs[name].dtype != spec.dtype
    ]
    yield from dtypes
    if unrated := before.said.action_hz is None:
        yield "the store does not say the rate of its ticks"
    if not (lines or changed or gone or dtypes or unrated):
        yield "the order of episodes, or how actions are derived, changed"


def _warnings(surveyed: Survey, before: RowSource | None, missing: int) -> Iterator[str]:
    """What may not be meant, each with the way out."""
    params, recordings, views = surveyed.params, surveyed.recordings, surveyed.spec.views
    known = before.said.feature_spec.views if before else []
    if known and (added := set(views) - set(known)):
        having = sum(not added.isdisjoint(recording.view_names()) for recording in recordings)
        kept = setting("data.views", [view for view in known if view in views])
        yield (
            f"{having} of {len(recordings)} episode(s) have {', '.join(sorted(added))}, which the "
            "store does not have. The model sees all views of a store at a time, so that every row "
            f"of every episode is computed again. To keep the rows: {kept}"
        )
    if not views and params.data.views != ():
        yield (
            f"none of the {len(recordings)} episode(s) has a frame, so that every row will hold "
            "the features of the instruction alone. Check data.views and the folders of images. "
            "To say that it is meant: --set data.views=[]"
        )
    without = [recording.source for recording in recordings if not recording.has_poses]
    if params.data.action_rotation == "auto" and 0 < len(without) < len(recordings):
        yield (
            f"{len(without)} of {len(recordings)} episode(s), of source(s) "
            f"{', '.join(dict.fromkeys(without))}, have no poses, so that the actions of all are "
            "euler_delta in place of rotvec. To keep rotvec: give these a store of their own. To "
            "say that it is meant: --set data.action_rotation=euler_delta"
        )
    # What the workers of a dask scheduler have is not known.
    if missing and params.vlm.dtype != "float32" and isinstance(params.extract.workers, int):
        from pipeline.base.device import resolve_device  # torch takes a second to import

        if resolve_device(params.extract.device).type == "cpu":
            yield (
                f"the model will run on the CPU in vlm.dtype {params.vlm.dtype}, which many CPUs "
                "only emulate, slowly. Set vlm.dtype=float32, or extract on a GPU, before the "
                "first long run: no row is taken over by another dtype"
            )


def count_known(
    checked: Sequence[CheckedEpisode], surveyed: Survey, sources: Sequence[RowSource]
) -> int:
    """How many rows of these episodes are in `sources`, as far as can be told without a frame."""
    count = 0
    for episode in checked:
        of = episode.said["content"], episode.said["instruction"]
        times = set().union(*(source.keys_of(*of) for source in sources))
        rows = episode.ticks.frame_times(surveyed.spec.views)
        count += sum(row.tobytes() in times for row in rows)
    return count
