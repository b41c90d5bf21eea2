"""The real recordings beside the project."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.data import Recording, open_recordings


@pytest.fixture
def load(shared_data: Path):
    def read(path: str) -> tuple[Recording, ...]:
        opened = open_recordings([Source(name="s", path=path)], shared_data)
        assert not opened.bad and not opened.missing
        return opened.recordings

    return read


def test_raw_and_new_are_the_same_episode(load):
    (raw,), (new,) = load("insertion/raw"), load("insertion/new")
    assert raw.instruction == new.instruction == "Blue point"
    np.testing.assert_array_equal(raw.sensor().values, new.sensor().values)
    np.testing.assert_allclose(raw.sensor().time, new.sensor().time, atol=1e-3)
    np.testing.assert_allclose(raw.state().values, new.state().values, atol=1e-4)
    np.testing.assert_allclose(raw.state().time, new.state().time, atol=0.02)
    assert list(raw.cameras()) == list(new.cameras()) == ["View1", "View2", "View3", "View5"]
    for view, camera in raw.cameras().items():
        np.testing.assert_allclose(camera.time, new.cameras()[view].time, atol=1e-3)
        assert [frame.ndim for frame in camera.read([0, 14])] == [3, 3]


def test_v21_and_v30_say_the_same_bit_for_bit(load):
    old, new = load("lerobot/cr5_banana_v21"), load("lerobot/cr5_banana_v30_split")
    assert [r.id for r in old] == [r.id for r in new] == [f"episode_{i:06d}" for i in range(5)]
    rows = 0
    for a, b in zip(old, new, strict=True):
        assert a.instruction == b.instruction == "put the banana on the plate"
        assert a.action().kind == "velocity" and a.action().rate_hz == 10
        for one, other in ((a.state(), b.state()), (a.action(), b.action())):
            np.testing.assert_array_equal(one.values, other.values)
            np.testing.assert_array_equal(one.time, other.time)
            assert one.channels == other.channels
            # The clock jitters, so that it stays as float32 stored it and stores stay as they are.
            np.testing.assert_array_equal(one.time, one.time.astype(np.float32))
        assert "clock" not in a.identity() + b.identity()
        one, other = a.cameras()["top"], b.cameras()["top"]
        np.testing.assert_array_equal(one.time, a.state().time)
        np.testing.assert_array_equal(one.time, other.time)
        indices = range(0, len(one.time), 25)
        one.check(indices)
        other.check(indices)
        for left, right in zip(one.read(indices), other.read(indices), strict=True):
            np.testing.assert_array_equal(left, right)
        rows += len(one.time)
    assert rows == 935
