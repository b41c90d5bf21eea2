"""What an extraction would do, and why; said before anything is done."""

import json
from collections.abc import Iterator, Sequence

from pipeline.base.digests import ContentDigests, joint_digest
from pipeline.base.durable import free_bytes
from pipeline.base.format import duration, size
from pipeline.extract.places import StorePlaces, spec_differences
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.store import FEATURES, RowSource, StoreBuild, read_plan
from pipeline.store.schema import ArraySpec

_DECIDES_SPEED = ("weights", "adapter", "processor", "compute_dtype", "variants")


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
    there = {digest for source in sources for digest in source.episode_digests}
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
    lines = spec_differences(before.attrs["feature_spec"], surveyed.spec.attrs())
    yield from (f"feature spec, {line}" for line in lines)
    digests, contents = set(before.episode_digests), set(before.episode_contents)
    changed = [episode for episode in surveyed.episodes if episode.digest not in digests]
    same_files = sum(episode.content in contents for episode in changed)
    here = {episode.digest for episode in surveyed.episodes}
    again = {episode.content for episode in changed}  # said as the new ones are
    pairs = zip(before.episode_digests, before.episode_contents, strict=True)
    gone = sum(digest not in here and content not in again for digest, content in pairs)
    for count, what in (
        (len(changed) - same_files, "are new or their files changed, or how these are read"),
        (same_files, "have another instruction, name, place, action_hz or vlm_reuse_count"),
        (gone, "of the store are gone or changed"),
    ):
        if count:
            yield f"{count} episode(s) {what}"
    dtypes = [
        f"{name} was {before.specs[name].dtype}, is to be {spec.dtype}"
        for name, spec in specs.items()
        if name != FEATURES and before.specs[name].dtype != spec.dtype
    ]
    yield from dtypes
    if not (lines or changed or gone or dtypes):
        yield "the order of episodes, or how actions are derived, changed"


def _warnings(surveyed: Survey, before: RowSource | None, missing: int) -> Iterator[str]:
    """What may not be meant, each with the way out."""
    params, recordings, views = surveyed.params, surveyed.recordings, surveyed.spec.views
    known: Sequence[str] = before.attrs["feature_spec"].get("views", ()) if before else ()
    if known and (added := set(views) - set(known)):
        having = sum(not added.isdisjoint(recording.view_names()) for recording in recordings)
        kept = ", ".join(view for view in known if view in views)
        yield (
            f"{having} of {len(recordings)} episode(s) have {', '.join(sorted(added))}, which the "
            "store does not have. The model sees all views of a store at a time, so that every row "
            f"of every episode is computed again. To keep the rows: --set 'data.views=[{kept}]'"
        )
    without = [recording.source for recording in recordings if not recording.has_poses]
    if params.data.action_rotation == "auto" and 0 < len(without) < len(recordings):
        yield (
            f"{len(without)} of {len(recordings)} episode(s), of source(s) "
            f"{', '.join(dict.fromkeys(without))}, have no poses, so that the actions of all "
            "episodes are differences of Euler angles (euler_delta) in place of rotation vectors "
            "(rotvec). To keep rotation vectors: leave these out of data.sources, or give them a "
            "store of their own. To say that it is meant: --set data.action_rotation=euler_delta"
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
        of = episode.surveyed.content, episode.surveyed.recording.instruction
        times = set().union(*(source.keys_of(*of) for source in sources))
        rows = episode.timeline.frame_times(surveyed.spec.views)
        count += sum(row.tobytes() in times for row in rows)
    return count
