"""Write everything of a store that needs no model: streams, ticks, episodes."""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.arrays import first_non_finite
from pipeline.base.config import stored_as
from pipeline.base.errors import ConfigError, DiskFull, NumericsError
from pipeline.base.files import free_bytes
from pipeline.base.provenance import tuned_on_attributes
from pipeline.base.text import size
from pipeline.data import Stream
from pipeline.data.timeline import Timeline, tick_hz
from pipeline.extract.build_state import store_bytes
from pipeline.extract.survey import CheckedEpisode, Survey, embodiment_of
from pipeline.store import FEATURES, SCHEMA, RowSource, Sizes, StoreBuild, arrays
from pipeline.store.episodes import episode_arrays
from pipeline.store.proofs import PROOF, find_proof
from pipeline.store.schema import BASIS, MOST_ROW_BYTES, ArraySpec
from pipeline.vlm.checkpoint_folder import tuned_on
from pipeline.vlm.feature_spec import FeatureSpec


def check_space(
    build: StoreBuild, checked: Sequence[CheckedEpisode], known: Sequence[RowSource]
) -> None:
    """Raise `DiskFull` where the store will not fit; chunks that can be linked do not count."""
    linked = sum(
        build.linkable(name, source.specs[name], rows) * build.specs[name].chunk_bytes
        for source, name, rows in _linkable(build, checked, known)
    )
    needed = store_bytes(build.specs) - linked
    free = free_bytes(build.part)
    if needed > free:
        raise DiskFull(
            f"{build.target}: the store needs {size(needed)}, {build.part.parent} has "
            f"{size(free)} free. Make room, or set another extract.store, extract.dtype or "
            "extract.sensor_dtype float16, or fewer vlm.pooling slots or vlm.variants."
        )


def lay_out(
    build: StoreBuild, checked: Sequence[CheckedEpisode], survey: Survey, known: Sequence[RowSource]
) -> None:
    """Write streams, ticks and episodes, linking unchanged chunks of a finished store.

    The plan is written last; after that the build can be resumed. Raises `DiskFull`.
    """
    build.create()
    for source, name, rows in _linkable(build, checked, known):
        build.link_unchanged(name, source.path, source.specs[name], rows)
    build.allocate()
    sources = [source.name for source in survey.data.sources]
    for name, values in episode_arrays(checked, sources, survey.spec.views).items():
        build.write(name, 0, values)
    valid = [_slot_valid(episode.ticks, survey.spec) for episode in checked]
    build.write("vl/slot_valid", 0, np.concatenate(valid))
    if survey.spec.basis is not None:
        build.write(BASIS, 0, survey.spec.basis.maps)
    starts = {"sensor": 0, "state": 0}
    for episode in tqdm(checked, "streams", unit="episode", disable=None, leave=False):
        _write_streams(build, episode, starts)
    attributes = _attributes(checked, survey)
    build.finish_layout(attributes, {"slots": attributes["slots"]})


def build_arrays(checked: Sequence[CheckedEpisode], survey: Survey) -> dict[str, ArraySpec]:
    """The arrays that these episodes need."""
    embodiment, extract, whole = embodiment_of(checked), survey.extract, survey.spec.whole
    count = Counter[str]()
    for episode in checked:
        count.update(episode.counts)
    sizes = Sizes(
        episode=len(checked),
        tick=count["tick"],
        vl_row=count["vl"],
        sensor_reading=count["sensor"],
        state_reading=count["state"],
        byte=count["text"],
        slot=len(survey.spec.slots) * survey.spec.variants,
        dim=survey.spec.dim,
        view=len(survey.spec.views),
        action_dim=len(embodiment.action.names),
        channel=len(embodiment.sensor.names),
        state_dim=len(embodiment.state.names),
        group=0 if whole is None else len(whole.groups),
        input=0 if whole is None else whole.dim + 1,
    )
    specs = arrays(sizes, stored_as(extract.dtype), extract.sensor_dtype)
    if BASIS in specs and (row_bytes := specs[BASIS].row_bytes) > MOST_ROW_BYTES:
        raise ConfigError(
            f"extract.dtype: the basis of a group would take {size(row_bytes)}, and no reader "
            f"takes more than {size(MOST_ROW_BYTES)}. Set a smaller pca."
        )
    if (row_bytes := specs[FEATURES].row_bytes) > MOST_ROW_BYTES:
        raise ConfigError(
            f"a row of features would take {size(row_bytes)}, and no reader takes more than "
            f"{size(MOST_ROW_BYTES)}. Set fewer vlm.layers, vlm.pooling slots or vlm.variants."
        )
    return specs


def _linkable(
    build: StoreBuild, checked: Sequence[CheckedEpisode], known: Sequence[RowSource]
) -> Iterator[tuple[RowSource, str, int]]:
    """Stream arrays of a finished store, and how many of their first rows are the same here.

    These are the rows of the leading episodes with unchanged content; only whole chunks can be
    linked.
    """
    for source in known:
        if source.path == build.target and not source.damaged:
            pairs = zip(source.texts, checked, strict=False)
            same = [*takewhile(lambda pair: pair[0].content == pair[1].fields["content"], pairs)]
            for stream in ("sensor", "state"):
                rows = sum(episode.counts[stream] for _, episode in same)
                yield source, f"{stream}/values", rows
                yield source, f"{stream}/time", rows


def _slot_valid(line: Timeline, spec: FeatureSpec) -> NDArray[np.uint8]:
    """The valid slots, (vl_row, slot): a view's slot needs that view, `image_mean` any view."""
    valid = [
        slot.view in line.frames
        if slot.view is not None
        else slot.pooling != "image_mean" or bool(line.frames)
        for slot in spec.slots
    ]
    return np.tile(np.array(valid, np.uint8), (len(line.vl_time), spec.variants))


def _write_streams(build: StoreBuild, episode: CheckedEpisode, starts: dict[str, int]) -> None:
    """Write an episode's readings at `starts`, and advance `starts` past them."""
    recording = episode.recording
    for kind, stream in (("sensor", recording.sensor()), ("state", recording.state())):
        if stream is not None:
            values = _stored(stream, build.specs[f"{kind}/values"])
            build.write(f"{kind}/values", starts[kind], values)
            build.write(f"{kind}/time", starts[kind], stream.time)
            starts[kind] += len(stream.time)


def _stored(stream: Stream, spec: ArraySpec) -> NDArray[Any]:
    with np.errstate(over="ignore"):
        values = stream.values.astype(spec.dtype)
    if (bad := first_non_finite(values)) is not None:
        row, column = bad
        raise NumericsError(
            f"{stream.channels.names[column]} = {stream.values[row, column]:g} at "
            f"{stream.time[row]:.3f} s does not fit {spec.dtype}; set extract.sensor_dtype=float32"
        )
    return values


def _attributes(checked: Sequence[CheckedEpisode], survey: Survey) -> dict[str, Any]:
    data = survey.data
    return {
        "schema": SCHEMA,
        "feature_spec": survey.spec.attrs(),
        "slots": survey.spec.document["slots"],
        "sources": [source.name for source in data.sources],
        "streams": embodiment_of(checked).document() | {"views": list(survey.spec.views)},
        "action_hz": tick_hz((episode.ticks.recorded_hz for episode in checked), data.action_hz),
        "vlm_reuse_count": data.vlm_reuse_count,
        "environment": [],
        **_proof(survey),
        **tuned_on_attributes(tuned_on(survey.vlm)),
    }


def _proof(survey: Survey) -> dict[str, Any]:
    """The attribute with what a probe found that this type of storage loses, if one did."""
    proof = find_proof(survey.target.parent, survey.spec.document)
    return {} if proof is None else {PROOF: proof.model_dump(mode="json")}
