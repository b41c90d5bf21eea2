"""The attributes and episodes of a small store, and changes to files of a finished store."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from pipeline.store.chunks import write_seal
from pipeline.store.schema import STREAMS, ArraySpec, chunk_paths, read_spec

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
    texts = np.frombuffer(TEXT * episodes, np.uint8)
    return edges | {"episode/source": np.zeros(episodes, "i4"), "episode/text": texts}


def content(root: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    files = (path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def chunk_file(store: Path, array: str, chunk: int = 0) -> Path:
    """A chunk file of an array."""
    return chunk_paths(store, read_spec(store, array))[chunk]


def flip(path: Path, offset: int, bit: int = 0) -> None:
    """Flip one bit of a file."""
    data = bytearray(path.read_bytes())
    data[offset] ^= 1 << bit
    path.write_bytes(data)


def put(store: Path, array: str, row: int | slice, value: object) -> None:
    """Write a value into a row, with the chunk's trailer and the store's seal, as wrong software
    would."""
    spec, path = read_spec(store, array), chunk_file(store, array)
    data = bytearray(path.read_bytes()[:-4])
    np.frombuffer(data, spec.dtype).reshape(-1, *spec.shape[1:])[row] = value
    path.write_bytes(bytes(data) + google_crc32c.value(bytes(data)).to_bytes(4, "little"))
    write_seal(store)


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a JSON document."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
