"""What a small store has to say of itself, whatever its arrays are."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.store.schema import STREAMS, ArraySpec

TEXT = (
    b'{"id": "e", "path": "e", "format": "new", "instruction": "i", "content": "c", "digest": "d"}'
)


def attributes_of(specs: Mapping[str, ArraySpec]) -> dict[str, Any]:
    """Root attributes of a store of these arrays."""

    def named(array: str) -> dict[str, Any]:
        width = specs[array].shape[1]
        return {"names": [f"c{n}" for n in range(width)], "units": ["µm"] * width}

    views = [f"View{n}" for n in range(specs["vl/frame_time"].shape[1])]
    slot = {"layer": 0, "norm": True, "pooling": "mean"}
    slots = [slot] * specs["vl/features"].shape[1]
    streams = {
        "action": {**named("tick/action"), "kind": "delta"},
        "sensor": named("sensor/values"),
        "state": named("state/values"),
        "views": views,
    }
    return {
        "schema": 1,
        "feature_spec": {"digest": "d", "views": views, "slots": slots},
        "slots": slots,
        "sources": ["lab"],
        "streams": streams,
        "action_hz": 10.0,
        "vlm_reuse_count": 3,
        "environment": [],
    }


def index_of(specs: Mapping[str, ArraySpec]) -> dict[str, NDArray[Any]]:
    """The arrays under `episode/`, of one episode that has all rows or several that share them."""
    (episodes,), text = specs["episode/source"].shape, specs["episode/text"].shape[0]
    rows = {stream: specs[f"{stream}/time"].shape[0] for stream in STREAMS} | {"text": text}
    edges = {
        f"episode/{stream}_start": np.arange(episodes + 1) * count // episodes
        for stream, count in rows.items()
    }
    said = np.frombuffer(TEXT * episodes, np.uint8)
    return edges | {"episode/source": np.zeros(episodes, "i4"), "episode/text": said}
