"""Write everything of a store that needs no model: streams, ticks, episodes."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.config import Params
from pipeline.errors import DiskFull, NumericsError
from pipeline.extraction.check import NO_CHANNELS, CheckedEpisode
from pipeline.extraction.survey import Survey, shown_path
from pipeline.recordings import Channels, Stream
from pipeline.store import SCHEMA, Donor, Sizes, StoreBuild, arrays, free_bytes
from pipeline.store.schema import ArraySpec
from pipeline.timeline import Timeline
from pipeline.vlm.feature_spec import FeatureSpec


def check_space(
    build: StoreBuild, checked: Sequence[CheckedEpisode], donors: Sequence[Donor]
) -> None:
    """Raise `DiskFull` where the store will not fit, chunks that can be linked left out."""
    linked = sum(
        build.linkable(name, donor.specs[name], rows) * build.specs[name].chunk_bytes
        for donor, name, rows in _linkable(build, checked, donors)
    )
    needed = sum(spec.data_bytes for spec in build.specs.values()) - linked
    free = free_bytes(build.part)
    if needed > free:
        raise DiskFull(
            f"{build.target}: the store needs {needed / 2**30:.2f} GiB, {build.part.parent} has "
            f"{free / 2**30:.2f} GiB free. Make room, or set extract.store to another disk, "
            "extract.dtype or extract.sensor_dtype to float16, or fewer vlm.pooling slots."
        )


def lay_out(
    build: StoreBuild,
    checked: Sequence[CheckedEpisode],
    survey: Survey,
    params: Params,
    donors: Sequence[Donor],
) -> None:
    """Write all but the feature rows; chunks of unchanged streams are linked from a finished store.

    Raises `DiskFull` where the disk fills up.
    """
    build.create()
    edges = _edges(checked)
    for donor, name, rows in _linkable(build, checked, donors):
        build.link_unchanged(name, donor.path, donor.specs[name], rows)
    build.allocate()
    for name, values in _whole_arrays(checked, survey, params, edges):
        build.write(name, 0, values)
    for index, episode in enumerate(
        tqdm(checked, "streams", unit="episode", disable=None, leave=False)
    ):
        _write_streams(build, episode, edges, index)
    build.finish_layout(_attributes(checked, survey, params), {"slots": _slots(survey.spec)})


def build_arrays(
    checked: Sequence[CheckedEpisode], survey: Survey, params: Params
) -> dict[str, ArraySpec]:
    """The arrays that these episodes need."""
    first = checked[0]
    sizes = Sizes(
        episodes=len(checked),
        ticks=sum(len(one.timeline.time) for one in checked),
        vl_rows=sum(len(one.timeline.vl_time) for one in checked),
        readings=sum(one.readings for one in checked),
        states=sum(one.states for one in checked),
        text_bytes=sum(map(len, _texts(checked, params))),
        slots=len(survey.spec.slots),
        dim=survey.spec.dim,
        views=len(survey.spec.views),
        action_dim=len(first.timeline.action_channels.names),
        sensor_channels=len(_channels(one.sensor for one in checked).names),
        state_dim=len(_channels(one.state for one in checked).names),
    )
    return arrays(sizes, params.extract.dtype, params.extract.sensor_dtype)


def _edges(checked: Sequence[CheckedEpisode]) -> dict[str, NDArray[np.int64]]:
    counts = {
        "tick": [len(one.timeline.time) for one in checked],
        "vl": [len(one.timeline.vl_time) for one in checked],
        "sensor": [one.readings for one in checked],
        "state": [one.states for one in checked],
    }
    return {kind: np.cumsum([0, *each], dtype=np.int64) for kind, each in counts.items()}


def _linkable(
    build: StoreBuild, checked: Sequence[CheckedEpisode], donors: Sequence[Donor]
) -> Iterator[tuple[Donor, str, int]]:
    """Stream arrays of a finished store, and how many of their first rows are the same here.

    Those of the leading episodes of unchanged content; only whole chunks of them can be linked.
    """
    edges = _edges(checked)
    for donor in donors:
        if donor.path != build.target:
            continue
        same = 0
        for known, one in zip(donor.episode_contents, checked, strict=False):
            if known != one.surveyed.content:
                break
            same += 1
        for stream in ("sensor", "state"):
            for part in ("values", "time"):
                yield donor, f"{stream}/{part}", int(edges[stream][same])


def _whole_arrays(
    checked: Sequence[CheckedEpisode],
    survey: Survey,
    params: Params,
    edges: Mapping[str, NDArray[np.int64]],
) -> Iterator[tuple[str, NDArray[Any]]]:
    lines = [one.timeline for one in checked]
    texts = _texts(checked, params)
    names = [source.name for source in params.data.sources]
    views = survey.spec.views

    def shifted(kind: str, values: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
        starts = edges[kind][:-1]
        return np.concatenate([one + start for one, start in zip(values, starts, strict=True)])

    yield "tick/time", np.concatenate([line.time for line in lines])
    yield "tick/action", np.concatenate([line.action for line in lines])
    yield "tick/vl_row", shifted("vl", [line.vl_row for line in lines])
    yield "tick/sensor_end", shifted("sensor", [line.sensor_end for line in lines])
    yield "tick/state_end", shifted("state", [line.state_end for line in lines])
    yield "vl/time", np.concatenate([line.vl_time for line in lines])
    yield "vl/frame_time", np.concatenate([line.frame_times(views) for line in lines])
    yield "vl/slot_valid", np.concatenate([_slot_valid(line, survey.spec) for line in lines])
    for kind, edge in edges.items():
        yield f"episode/{kind}_start", edge
    yield "episode/text_start", np.cumsum([0, *map(len, texts)], dtype=np.int64)
    yield "episode/text", np.frombuffer(b"".join(texts), np.uint8)
    source = [names.index(one.surveyed.recording.source) for one in checked]
    yield "episode/source", np.array(source, np.int32)


def _slot_valid(line: Timeline, spec: FeatureSpec) -> NDArray[np.uint8]:
    """A slot of a view needs that view; `image_mean` needs any."""
    valid = [
        slot.view in line.frames
        if slot.view is not None
        else slot.pooling != "image_mean" or bool(line.frames)
        for slot in spec.slots
    ]
    return np.tile(np.array(valid, np.uint8), (len(line.vl_time), 1))


def _write_streams(
    build: StoreBuild,
    episode: CheckedEpisode,
    edges: Mapping[str, NDArray[np.int64]],
    index: int,
) -> None:
    recording = episode.surveyed.recording
    for kind, stream in (("sensor", recording.sensor()), ("state", recording.state())):
        if stream is not None:
            start = int(edges[kind][index])
            build.write(f"{kind}/values", start, _stored(stream, build.specs[f"{kind}/values"]))
            build.write(f"{kind}/time", start, stream.time)


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


def _texts(checked: Sequence[CheckedEpisode], params: Params) -> list[bytes]:
    return [
        json.dumps(
            {
                "id": one.surveyed.recording.id,
                "path": shown_path(one.surveyed.recording.path, params.data.root),
                "format": one.surveyed.recording.format,
                "instruction": one.surveyed.recording.instruction,
                "content": one.surveyed.content,
                "digest": one.surveyed.digest,
            },
            ensure_ascii=False,
        ).encode()
        for one in checked
    ]


def _attributes(
    checked: Sequence[CheckedEpisode], survey: Survey, params: Params
) -> dict[str, Any]:
    action = checked[0].timeline
    return {
        "schema": SCHEMA,
        "feature_spec": survey.spec.attrs(),
        "slots": _slots(survey.spec),
        "sources": [source.name for source in params.data.sources],
        "streams": {
            "action": {**_named(action.action_channels), "kind": action.action_kind},
            "sensor": _named(_channels(one.sensor for one in checked)),
            "state": _named(_channels(one.state for one in checked)),
            "views": list(survey.spec.views),
        },
        "action_hz": params.data.action_hz,
        "vlm_reuse_count": params.data.vlm_reuse_count,
        "environment": [],
    }


def _slots(spec: FeatureSpec) -> list[dict[str, Any]]:
    return [slot.document() for slot in spec.slots]


def _named(channels: Channels) -> dict[str, list[str]]:
    return {"names": list(channels.names), "units": list(channels.units)}


def _channels(found: Iterator[Channels]) -> Channels:
    return next((channels for channels in found if channels.names), NO_CHANNELS)
