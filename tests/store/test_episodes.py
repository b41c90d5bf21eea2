"""Episodes one behind the other: their arrays agree, and give the episodes back."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.store import FeatureStore
from pipeline.store.episodes import FIELDS, EpisodeRows, episode_arrays

REUSE = 3


@dataclass
class Ticks:
    """Of an episode, at 10 Hz; streams have a reading every 0.03 s."""

    count: int
    readings: int

    @property
    def time(self) -> NDArray[np.float64]:
        return np.arange(self.count) / 10

    @property
    def action(self) -> NDArray[np.float32]:
        return np.ones((self.count, 2), np.float32)

    @property
    def vl_row(self) -> NDArray[np.int64]:
        return np.arange(self.count) // REUSE

    @property
    def vl_time(self) -> NDArray[np.float64]:
        return self.time[::REUSE]

    @property
    def sensor_end(self) -> NDArray[np.int64]:
        return np.minimum(np.arange(self.count) * 3, self.readings)

    state_end = sensor_end

    def frame_times(self, views) -> NDArray[np.float64]:
        return np.repeat(self.vl_time[:, None], len(views), axis=1)


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 40)), min_size=1, max_size=6))
def test_their_arrays_agree_and_give_them_back(hold_together, counts):
    said = [{name: f"{name} {at}, ü" for name in FIELDS} for at in range(len(counts))]
    rows = [
        EpisodeRows(Ticks(ticks, readings), readings, readings, "ab"[at % 2], said[at])
        for at, (ticks, readings) in enumerate(counts)
    ]
    arrays = episode_arrays(rows, ["a", "b"], ["View1"])
    for stream in ("sensor", "state"):
        readings = [np.arange(one.readings) * 0.03 for one in rows]
        arrays |= {f"{stream}/time": np.concatenate(readings)}
        arrays |= {f"{stream}/values": np.zeros((sum(map(len, readings)), 1), np.float32)}
    names = {stream: {"names": ["x"]} for stream in ("sensor", "state")}
    attributes = {
        "sources": ["a", "b"],
        "vlm_reuse_count": REUSE,
        "streams": {"action": {"names": ["x", "y"]}, **names, "views": ["View1"]},
    }
    store = FeatureStore(Path("nowhere"), attributes, arrays)
    hold_together(store)
    assert [(len(one.ticks), len(one.readings)) for one in store.episodes] == counts
    assert [{name: getattr(one, name) for name in FIELDS} for one in store.episodes] == said
    assert [one.source for one in store.episodes] == ["ab"[at % 2] for at in range(len(counts))]
