"""Episodes one behind the other: their arrays agree, and give the episodes back."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.store import FeatureStore
from pipeline.store.episodes import FIELDS, EpisodeRows, episode_arrays

REUSE = 3


def ticks_of(count: int, readings: int) -> SimpleNamespace:
    """The ticks of an episode, at 10 Hz; streams have a reading every 0.03 s."""
    tick = np.arange(count)
    vl_time = tick[::REUSE] / 10
    end = np.minimum(tick * 3, readings)
    return SimpleNamespace(
        time=tick / 10,
        action=np.ones((count, 2), np.float32),
        vl_row=tick // REUSE,
        vl_time=vl_time,
        sensor_end=end,
        state_end=end,
        frame_times=lambda views: np.repeat(vl_time[:, None], len(views), axis=1),
    )


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 40)), min_size=1, max_size=6))
def test_their_arrays_agree_and_give_them_back(hold_together, counts):
    said = [{name: f"{name} {at}, ü" for name in FIELDS} for at in range(len(counts))]
    rows = [
        EpisodeRows(ticks_of(ticks, readings), readings, readings, "ab"[at % 2], said[at])
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
