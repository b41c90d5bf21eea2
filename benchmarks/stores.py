"""Large synthetic stores, written by the project's own writer."""

import json
import os
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.store import SCHEMA, Sizes, StoreBuild, arrays
from pipeline.store.schema import ArraySpec

ACTION_DIM = 7
_BLOCK_BYTES = 64 * 2**20


def write_store(
    target: Path,
    *,
    episodes: int,
    ticks: int,
    readings: int,
    states: int,
    reuse: int = 3,
    slots: int = 1,
    tokens: tuple[int, int] | None = None,
    dim: int = 2048,
    dtype: str = "float16",
    channels: int = 1026,
    state_dim: int = 7,
) -> Path:
    """A finished store of random content; `ticks`, `readings` and `states` are an episode's.

    `tokens` are rows and columns of a view's tokens, which then are the slots.
    """
    rows = -(-ticks // reuse)
    named_slots = _named_slots(slots, tokens)
    slots = len(named_slots)
    said = [json.dumps(_said(index)).encode() for index in range(episodes)]
    sizes = Sizes(
        episode=episodes,
        tick=episodes * ticks,
        vl_row=episodes * rows,
        sensor_reading=episodes * readings,
        state_reading=episodes * states,
        byte=sum(map(len, said)),
        slot=slots,
        dim=dim,
        view=1,
        action_dim=ACTION_DIM,
        channel=channels,
        state_dim=state_dim,
    )
    build = StoreBuild(target, arrays(sizes, dtype, "float32"), plan=target.name)
    build.create()
    build.allocate()
    for name, values in _layout(episodes, ticks, readings, states, rows, reuse).items():
        build.write(name, 0, values)
    build.write("episode/text_start", 0, np.cumsum([0, *map(len, said)]))
    build.write("episode/text", 0, np.frombuffer(b"".join(said), np.uint8))
    build.write("vl/slot_valid", 0, np.ones((sizes.vl_row, slots), np.uint8))
    for name in ("tick/action", "state/values", "sensor/values"):
        _write_random(build, name)
    attributes = _attributes(channels, state_dim, reuse, named_slots)
    build.finish_layout(attributes, {"slots": attributes["slots"]})
    _commit_random(build)
    build.seal()
    return target


def _layout(
    episodes: int, ticks: int, readings: int, states: int, rows: int, reuse: int
) -> dict[str, NDArray[np.generic]]:
    """Clocks and indices: every stream evenly spread over its episode."""
    episode, inside = np.divmod(np.arange(episodes * ticks), ticks)
    edges = np.arange(episodes + 1)

    def clock(count: int) -> NDArray[np.generic]:
        return np.tile(np.arange(count) * (0.1 * ticks / max(1, count)), episodes)

    return {
        "tick/time": clock(ticks),
        "tick/vl_row": episode * rows + inside // reuse,
        "tick/sensor_end": episode * readings + (inside + 1) * readings // ticks,
        "tick/state_end": episode * states + (inside + 1) * states // ticks,
        "vl/time": clock(rows),
        "vl/frame_time": clock(rows)[:, None],
        "sensor/time": clock(readings),
        "state/time": clock(states),
        "episode/tick_start": edges * ticks,
        "episode/vl_start": edges * rows,
        "episode/sensor_start": edges * readings,
        "episode/state_start": edges * states,
        "episode/source": np.zeros(episodes, np.int32),
    }


def _named_slots(slots: int, tokens: tuple[int, int] | None) -> list[dict[str, Any]]:
    layer = {"layer": 0, "norm": True}
    if tokens is None:
        return [layer | {"pooling": "mean"}] * slots
    cells = product(*map(range, tokens))
    return [layer | {"pooling": "tokens", "view": "View1", "cell": [*cell]} for cell in cells]


def _attributes(
    channels: int, state_dim: int, reuse: int, named_slots: list[dict[str, Any]]
) -> dict[str, object]:
    def named(prefix: str, width: int) -> dict[str, list[str]]:
        return {"names": [f"{prefix}_{i}" for i in range(width)], "units": [""] * width}

    return {
        "schema": SCHEMA,
        "feature_spec": {"digest": "synthetic", "views": ["View1"], "slots": named_slots},
        "slots": named_slots,
        "sources": ["synthetic"],
        "streams": {
            "action": {**named("action", ACTION_DIM), "kind": "delta"},
            "sensor": named("sensor", channels),
            "state": named("joint", state_dim),
            "views": ["View1"],
        },
        "action_hz": 10.0,
        "vlm_reuse_count": reuse,
        "environment": [],
    }


def _said(index: int) -> dict[str, str]:
    name = f"episode_{index:06d}"
    return {
        "id": name,
        "path": f"recordings/{name}",
        "format": "new",
        "instruction": "insert the needle",
        "content": name,
        "digest": name,
    }


def _write_random(build: StoreBuild, name: str) -> None:
    spec = build.specs[name]
    if not spec.data_bytes:
        return
    block = _random_rows(spec)
    with tqdm(total=spec.data_bytes, desc=name, unit="B", unit_scale=True, disable=None) as bar:
        for start in range(0, spec.shape[0], len(block)):
            part = block[: spec.shape[0] - start]
            build.write(name, start, part)
            bar.update(part.nbytes)


def _commit_random(build: StoreBuild) -> None:
    spec = build.specs["vl/features"]
    block = _random_rows(spec)
    keys = [index.to_bytes(16, "little") for index in range(spec.shape[0])]
    environment = build.environment_index({"synthetic": True})
    for start in tqdm(range(0, spec.shape[0], len(block)), desc=spec.name, disable=None):
        part = block[: spec.shape[0] - start]
        rows = np.arange(start, start + len(part))
        build.commit(rows, part, keys[start : start + len(part)], environment)


def _random_rows(spec: ArraySpec) -> NDArray[np.generic]:
    """A block of rows of an array, or all of them where it has fewer."""
    rows = min(spec.shape[0], max(1, _BLOCK_BYTES // spec.row_bytes))
    rng = np.random.default_rng(0)
    return rng.standard_normal((rows, *spec.shape[1:]), np.float32).astype(spec.dtype)


def evict(folder: Path) -> None:
    """Drop the clean pages of all files below `folder` from the page cache.

    Pages that a process maps stay, so nothing may have the files mapped.
    """
    for path in folder.rglob("*"):
        if path.is_file():
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fdatasync(descriptor)
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(descriptor)
