"""What an extraction will do, and why; printed before anything is done."""

from collections.abc import Iterator, Sequence

from pipeline.base.config import setting
from pipeline.base.digests import ContentDigests
from pipeline.base.files import free_bytes
from pipeline.base.text import duration, size
from pipeline.extract.state import BuildState, StorePlaces, spec_differences
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.store import FEATURES, RowSource, StoreBuild, read_plan
from pipeline.store.schema import ArraySpec


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
        reasons = _reasons(surveyed, before, build.specs)
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


def _reasons(
    surveyed: Survey, before: RowSource | None, specs: dict[str, ArraySpec]
) -> Iterator[str]:
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
    dtypes = [
        f"{name} was {before.specs[name].dtype}, is to be {spec.dtype}"
        for name, spec in specs.items()
        if name != FEATURES and before.specs[name].dtype != spec.dtype
    ]
    yield from dtypes
    if unrated := before.attributes.action_hz is None:
        yield "the store does not say the rate of its ticks"
    if not (lines or changed or gone or dtypes or unrated):
        yield "the order of episodes, or how actions are derived, changed"


def _warnings(surveyed: Survey, before: RowSource | None, missing: int) -> Iterator[str]:
    """What the user may not intend, each with what to do about it."""
    params, recordings, views = surveyed.params, surveyed.recordings, surveyed.spec.views
    known = before.attributes.feature_spec.views if before else []
    if known and (added := set(views) - set(known)):
        count = sum(not added.isdisjoint(recording.view_names()) for recording in recordings)
        kept = setting("data.views", [view for view in known if view in views])
        yield (
            f"{count} of {len(recordings)} episode(s) have {', '.join(sorted(added))}, which the "
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
    # The devices of the workers of a dask scheduler are not known.
    if missing and params.vlm.dtype != "float32" and isinstance(params.extract.workers, int):
        from pipeline.base.machine import resolve_device  # torch takes a second to import

        if resolve_device(params.extract.device).type == "cpu":
            yield (
                f"the model will run on the CPU in vlm.dtype {params.vlm.dtype}, which many CPUs "
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
