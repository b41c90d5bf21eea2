"""Write everything of a store that needs no model: streams, ticks, episodes."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.durable import free_bytes
from pipeline.base.errors import DiskFull, NumericsError
from pipeline.base.format import size
from pipeline.data import Stream
from pipeline.data.timeline import Timeline
from pipeline.extract.check import CheckedEpisode, embodiment_of
from pipeline.extract.plan import store_bytes
from pipeline.extract.survey import Survey, shown_path
from pipeline.store import SCHEMA, RowSource, Sizes, StoreBuild, arrays
from pipeline.store.episodes import EpisodeRows, episode_arrays, episode_edges
from pipeline.store.schema import ArraySpec
from pipeline.vlm.feature_spec import FeatureSpec


def check_space(
    build: StoreBuild, checked: Sequence[CheckedEpisode], donors: Sequence[RowSource]
) -> None:
    """Raise `DiskFull` where the store will not fit, chunks that can be linked left out."""
    linked = sum(
        build.linkable(name, donor.specs[name], rows) * build.specs[name].chunk_bytes
        for donor, name, rows in _linkable(build, checked, donors)
    )
    needed = store_bytes(build.specs) - linked
    free = free_bytes(build.part)
    if needed > free:
        raise DiskFull(
            f"{build.target}: the store needs {size(needed)}, {build.part.parent} has "
            f"{size(free)} free. Make room, or set extract.store to another disk, "
            "extract.dtype or extract.sensor_dtype to float16, or fewer vlm.pooling slots or "
            "vlm.variants."
        )


def lay_out(
    build: StoreBuild,
    checked: Sequence[CheckedEpisode],
    survey: Survey,
    params: Params,
    donors: Sequence[RowSource],
) -> None:
    """Write all but the feature rows; chunks of unchanged streams are linked from a finished store.

    Raises `DiskFull` where the disk fills up.
    """
    build.create()
    for donor, name, rows in _linkable(build, checked, donors):
        build.link_unchanged(name, donor.path, donor.specs[name], rows)
    build.allocate()
    sources = [source.name for source in params.data.sources]
    for name, values in episode_arrays(
        _episodes(checked, params), sources, survey.spec.views
    ).items():
        build.write(name, 0, values)
    valid = [_slot_valid(one.timeline, survey.spec) for one in checked]
    build.write("vl/slot_valid", 0, np.concatenate(valid))
    starts = {"sensor": 0, "state": 0}
    for episode in tqdm(checked, "streams", unit="episode", disable=None, leave=False):
        _write_streams(build, episode, starts)
    build.finish_layout(_attributes(checked, survey, params), {"slots": survey.spec.stored_slots()})


def build_arrays(
    checked: Sequence[CheckedEpisode], survey: Survey, params: Params
) -> dict[str, ArraySpec]:
    """The arrays that these episodes need."""
    embodiment = embodiment_of(checked)
    ends = {kind: int(edge[-1]) for kind, edge in episode_edges(_episodes(checked, params)).items()}
    sizes = Sizes(
        episodes=len(checked),
        ticks=ends["tick"],
        vl_rows=ends["vl"],
        readings=ends["sensor"],
        states=ends["state"],
        text_bytes=ends["text"],
        slots=len(survey.spec.slots) * survey.spec.variants,
        dim=survey.spec.dim,
        views=len(survey.spec.views),
        action_dim=len(embodiment.action.names),
        sensor_channels=len(embodiment.sensor.names),
        state_dim=len(embodiment.state.names),
    )
    return arrays(sizes, params.extract.dtype, params.extract.sensor_dtype)


def _episodes(checked: Sequence[CheckedEpisode], params: Params) -> list[EpisodeRows]:
    return [
        EpisodeRows(
            one.timeline,
            one.readings,
            one.states,
            one.surveyed.recording.source,
            {
                "id": one.surveyed.recording.id,
                "path": shown_path(one.surveyed.recording.path, params.data.root),
                "format": one.surveyed.recording.format,
                "instruction": one.surveyed.recording.instruction,
                "content": one.surveyed.content,
                "digest": one.surveyed.digest,
            },
        )
        for one in checked
    ]


def _linkable(
    build: StoreBuild, checked: Sequence[CheckedEpisode], donors: Sequence[RowSource]
) -> Iterator[tuple[RowSource, str, int]]:
    """Stream arrays of a finished store, and how many of their first rows are the same here.

    Those of the leading episodes of unchanged content; only whole chunks of them can be linked.
    """
    for donor in donors:
        if donor.path != build.target:
            continue
        same = 0
        for known, one in zip(donor.episode_contents, checked, strict=False):
            if known != one.surveyed.content:
                break
            same += 1
        readings = sum(one.readings for one in checked[:same])
        states = sum(one.states for one in checked[:same])
        for stream, rows in (("sensor", readings), ("state", states)):
            for part in ("values", "time"):
                yield donor, f"{stream}/{part}", rows


def _slot_valid(line: Timeline, spec: FeatureSpec) -> NDArray[np.uint8]:
    """A slot of a view needs that view; `image_mean` needs any."""
    valid = [
        slot.view in line.frames
        if slot.view is not None
        else slot.pooling != "image_mean" or bool(line.frames)
        for slot in spec.slots
    ]
    return np.tile(np.array(valid, np.uint8), (len(line.vl_time), spec.variants))


def _write_streams(build: StoreBuild, episode: CheckedEpisode, starts: dict[str, int]) -> None:
    """Write an episode's readings at `starts`, and move these behind them."""
    recording = episode.surveyed.recording
    for kind, stream in (("sensor", recording.sensor()), ("state", recording.state())):
        if stream is not None:
            values = _stored(stream, build.specs[f"{kind}/values"])
            build.write(f"{kind}/values", starts[kind], values)
            build.write(f"{kind}/time", starts[kind], stream.time)
            starts[kind] += len(stream.time)


def _stored(stream: Stream, spec: ArraySpec) -> NDArray[Any]:
    with np.errstate(over="ignore"):
        values = stream.values.astype(spec.dtype)
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise NumericsError(
            f"{stream.channels.names[column]} = {stream.values[row, column]:g} at "
            f"{stream.time[row]:.3f} s does not fit {spec.dtype}; set extract.sensor_dtype=float32"
        )
    return values


def _attributes(
    checked: Sequence[CheckedEpisode], survey: Survey, params: Params
) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "feature_spec": survey.spec.attrs(),
        "slots": survey.spec.stored_slots(),
        "sources": [source.name for source in params.data.sources],
        "streams": embodiment_of(checked).document() | {"views": list(survey.spec.views)},
        "action_hz": params.data.action_hz,
        "vlm_reuse_count": params.data.vlm_reuse_count,
        "environment": [],
    }
