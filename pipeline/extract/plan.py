"""What an extraction would do, and why; said before anything is done."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.base.config import DataParams, Params
from pipeline.base.differences import describe, differences
from pipeline.base.format import duration, size
from pipeline.extract.check import CheckedEpisode
from pipeline.extract.survey import Survey
from pipeline.store import FEATURES, RowSource
from pipeline.store.schema import ArraySpec

_MOST_DIFFERENCES = 6
"""Lines on how a feature spec changed."""


@dataclass(frozen=True)
class ExtractionPlan:
    """Rows, bytes and reasons."""

    episodes: int
    unchanged: int
    """Episodes that an earlier store holds just so."""
    rows: int
    known: int
    """Rows of the interrupted build, or of the same frames in an earlier store."""
    variants: int
    """Of each row, each of which the model has to see."""
    bytes: int
    free: int
    rows_per_s: float | None
    """As measured in the last session with this model, resolution and device."""
    reasons: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    """What costs more than it need, and the way out."""

    def lines(self) -> list[str]:
        """For people."""
        left = self.rows - self.known
        if not left:
            time = "none, the model is not needed"
        elif self.rows_per_s is None:
            time = "not known before a first session of this store with this model and device"
        else:
            seconds = left / self.rows_per_s
            time = f"about {duration(seconds)} at {self.rows_per_s:.1f} rows/s, as last measured"
        return [
            *(f"WARNING: {warning}" for warning in self.warnings),
            *(f"why: {reason}" for reason in self.reasons),
            f"episodes: {self.episodes}, {self.unchanged} of them unchanged",
            f"rows: {self.rows}, {self.known} known, {left} to compute"
            + (f" in {self.variants} variants each" if left and self.variants > 1 else "")
            + (" (fewer where a key turns out to be known)" if left and self.known else ""),
            f"disk: {size(self.bytes)} for the whole store, {size(self.free)} free",
            f"time: {time}",
        ]


def store_bytes(specs: dict[str, ArraySpec]) -> int:
    """Bytes that a store's rows take."""
    return sum(spec.data_bytes for spec in specs.values())


def reasons(
    survey: Survey, store: RowSource | None, specs: dict[str, ArraySpec]
) -> tuple[str, ...]:
    """Why the store that is there, if any, will not do."""
    if store is None:
        return ("there is no store yet",)
    lines = spec_differences(store.attrs["feature_spec"], survey.spec.attrs())
    why = [f"feature spec, {line}" for line in lines]
    before, now = set(store.episode_digests), {one.digest for one in survey.episodes}
    contents = set(store.episode_contents)
    changed = [one for one in survey.episodes if one.digest not in before]
    new = sum(one.content not in contents for one in changed)
    if new:
        why.append(f"{new} episode(s) are new or their files changed, or how these are read")
    if len(changed) > new:
        why.append(
            f"{len(changed) - new} episode(s) have another instruction, name, place, action_hz or "
            "vlm_reuse_count"
        )
    again = {one.content for one in changed}  # said above
    gone = [
        digest
        for digest, content in zip(store.episode_digests, store.episode_contents, strict=True)
        if digest not in now and content not in again
    ]
    if gone:
        why.append(f"{len(gone)} episode(s) of the store are gone or changed")
    for name, spec in specs.items():
        if name != FEATURES and store.specs[name].dtype != spec.dtype:
            why.append(f"{name} was {store.specs[name].dtype}, is to be {spec.dtype}")
    return tuple(why) or ("the order of episodes, or how actions are derived, changed",)


def spec_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What differs between two feature specs, without all that follows from it."""
    lines = describe(differences(before, now))
    follow = [line for line in lines if line.startswith(("slots", "example_prompt"))]
    first = [line for line in lines if line not in follow] or follow
    left = len(lines) - len(first[:_MOST_DIFFERENCES])
    more = [f"{left} more entries, most of which follow from that"] if left else []
    return [*first[:_MOST_DIFFERENCES], *more]


def warnings(survey: Survey, store: RowSource | None, data: DataParams) -> tuple[str, ...]:
    """What makes every row or action another one, with the way out."""
    found: list[str] = []
    recordings = [one.recording for one in survey.episodes]
    before: Sequence[str] = store.attrs["feature_spec"].get("views", ()) if store else ()
    now = survey.spec.views
    if before and (added := [view for view in now if view not in before]):
        having = sum(not set(added).isdisjoint(one.view_names()) for one in recordings)
        kept = ", ".join(view for view in before if view in now)
        found.append(
            f"{having} of {len(recordings)} episode(s) have {', '.join(added)}, which the store "
            "does not have. The model sees all views of a store at a time, so that every row of "
            f"every episode is computed again. To keep the rows: --set 'data.views=[{kept}]'"
        )
    without = [one for one in recordings if not one.has_poses]
    if data.action_rotation == "auto" and 0 < len(without) < len(recordings):
        sources = ", ".join(dict.fromkeys(one.source for one in without))
        found.append(
            f"{len(without)} of {len(recordings)} episode(s), of source(s) {sources}, have no "
            "poses, so that the actions of all episodes are differences of Euler angles "
            "(euler_delta) in place of rotation vectors (rotvec). To keep rotation vectors: leave "
            "these out of data.sources, or give them a store of their own. To say that it is "
            "meant: --set data.action_rotation=euler_delta"
        )
    return tuple(found)


def dtype_warnings(params: Params, missing: int) -> tuple[str, ...]:
    """Whether so many rows would be computed in half precision on a CPU.

    What the workers of a dask scheduler have is not known.
    """
    from pipeline.base.device import resolve_device  # torch takes a second to import

    narrow, workers = params.vlm.dtype, params.extract.workers
    if not missing or narrow == "float32" or isinstance(workers, str):
        return ()
    if resolve_device(params.extract.device).type != "cpu":
        return ()
    return (
        f"the model will run on the CPU in vlm.dtype {narrow}, which many CPUs only emulate, "
        "slowly. Set vlm.dtype=float32, or extract on a GPU; decide before the first long run: a "
        "feature's dtype is part of its identity, and no row is taken over by another dtype",
    )


def known_rows(
    checked: Sequence[CheckedEpisode], views: Sequence[str], donors: Sequence[RowSource]
) -> int:
    """How many rows donors are known to have before a frame is decoded."""
    count = 0
    for one in checked:
        said = one.surveyed.content, one.surveyed.recording.instruction
        known = set().union(*(donor.keys_of(*said) for donor in donors))
        rows = one.timeline.frame_times(views)
        count += sum(row.tobytes() in known for row in rows)
    return count
