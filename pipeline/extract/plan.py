"""What an extraction would do, and why; said before anything is done."""

import json
from collections.abc import Sequence

from pipeline.base.digests import ContentDigests, joint_digest
from pipeline.base.durable import free_bytes
from pipeline.base.format import duration, size
from pipeline.extract.places import StorePlaces, spec_differences
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.store import FEATURES, RowSource, StoreBuild
from pipeline.store.schema import ArraySpec

_DECIDES_SPEED = ("weights", "adapter", "processor", "compute_dtype", "variants")


def plan_lines(
    build: StoreBuild,
    surveyed: Survey,
    digests: ContentDigests,
    unchanged: int,
    known: int,
    reasons: Sequence[str],
    warnings: Sequence[str] = (),
) -> list[str]:
    """What there is to do, for people: so many episodes are unchanged, so many rows known."""
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
        *(f"WARNING: {warning}" for warning in (*warnings, *_dtype_warnings(surveyed, left))),
        *(f"why: {reason}" for reason in reasons),
        f"episodes: {len(surveyed.episodes)}, {unchanged} of them unchanged",
        f"rows: {rows}, {known} known, {left} to compute"
        + (f" in {variants} variants each" if left and variants > 1 else "")
        + (" (fewer where a key turns out to be known)" if left and known else ""),
        f"disk: {needed} for the whole store, {free} free",
        f"time: {time}",
    ]


def new_plan_lines(
    build: StoreBuild,
    surveyed: Survey,
    digests: ContentDigests,
    places: StorePlaces,
    sources: Sequence[RowSource],
    known: int,
) -> list[str]:
    """`plan_lines` of a new build; `sources` are stores and builds of the same feature spec."""
    there = {digest for source in sources for digest in source.episode_digests}
    unchanged = sum(episode.digest in there for episode in surveyed.episodes)
    place, plan = places.target, places.finished
    if places.repaired:
        place, plan = places.part, places.begun
    before = None if plan is None else RowSource(place)
    reasons = _reasons(surveyed, before, build.specs)
    if places.begun == surveyed.plan and (damage := places.layout_damage()):
        reasons = [f"{damage}; streams are laid out again, the feature rows are kept"]
    warnings = [*_view_warnings(surveyed, before), *_rotation_warnings(surveyed)]
    return plan_lines(build, surveyed, digests, unchanged, known, reasons, warnings)


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


def _reasons(surveyed: Survey, before: RowSource | None, specs: dict[str, ArraySpec]) -> list[str]:
    """Why the store that is there, if any, will not do."""
    if before is None:
        return ["there is no store yet"]
    lines = spec_differences(before.attrs["feature_spec"], surveyed.spec.attrs())
    why = [f"feature spec, {line}" for line in lines]
    digests, contents = set(before.episode_digests), set(before.episode_contents)
    changed = [episode for episode in surveyed.episodes if episode.digest not in digests]
    new = sum(episode.content not in contents for episode in changed)
    if new:
        why.append(f"{new} episode(s) are new or their files changed, or how these are read")
    if len(changed) > new:
        why.append(
            f"{len(changed) - new} episode(s) have another instruction, name, place, action_hz or "
            "vlm_reuse_count"
        )
    here = {episode.digest for episode in surveyed.episodes}
    again = {episode.content for episode in changed}  # said above
    pairs = zip(before.episode_digests, before.episode_contents, strict=True)
    gone = sum(digest not in here and content not in again for digest, content in pairs)
    if gone:
        why.append(f"{gone} episode(s) of the store are gone or changed")
    for name, spec in specs.items():
        if name != FEATURES and before.specs[name].dtype != spec.dtype:
            why.append(f"{name} was {before.specs[name].dtype}, is to be {spec.dtype}")
    return why or ["the order of episodes, or how actions are derived, changed"]


def _view_warnings(surveyed: Survey, before: RowSource | None) -> list[str]:
    """Where a new view makes every row another one, with the way out."""
    known: Sequence[str] = before.attrs["feature_spec"].get("views", ()) if before else ()
    now, recordings = surveyed.spec.views, surveyed.recordings
    added = [view for view in now if view not in known]
    if not known or not added:
        return []
    having = sum(not set(added).isdisjoint(one.view_names()) for one in recordings)
    kept = ", ".join(view for view in known if view in now)
    return [
        f"{having} of {len(recordings)} episode(s) have {', '.join(added)}, which the store "
        "does not have. The model sees all views of a store at a time, so that every row of "
        f"every episode is computed again. To keep the rows: --set 'data.views=[{kept}]'"
    ]


def _rotation_warnings(surveyed: Survey) -> list[str]:
    """Where some recordings decide how the actions of all are derived, with the way out."""
    recordings = surveyed.recordings
    without = [recording for recording in recordings if not recording.has_poses]
    asked = surveyed.params.data.action_rotation
    if asked != "auto" or not 0 < len(without) < len(recordings):
        return []
    sources = ", ".join(dict.fromkeys(recording.source for recording in without))
    return [
        f"{len(without)} of {len(recordings)} episode(s), of source(s) {sources}, have no "
        "poses, so that the actions of all episodes are differences of Euler angles "
        "(euler_delta) in place of rotation vectors (rotvec). To keep rotation vectors: leave "
        "these out of data.sources, or give them a store of their own. To say that it is "
        "meant: --set data.action_rotation=euler_delta"
    ]


def _dtype_warnings(surveyed: Survey, missing: int) -> list[str]:
    """Whether so many rows would be computed in half precision on a CPU.

    What the workers of a dask scheduler have is not known.
    """
    from pipeline.base.device import resolve_device  # torch takes a second to import

    params = surveyed.params
    narrow, workers = params.vlm.dtype, params.extract.workers
    if not missing or narrow == "float32" or isinstance(workers, str):
        return []
    if resolve_device(params.extract.device).type != "cpu":
        return []
    return [
        f"the model will run on the CPU in vlm.dtype {narrow}, which many CPUs only emulate, "
        "slowly. Set vlm.dtype=float32, or extract on a GPU; decide before the first long run: a "
        "feature's dtype is part of its identity, and no row is taken over by another dtype"
    ]


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
