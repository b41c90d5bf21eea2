"""Windows of the newest readings, and what a policy is given of them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.robot.memory import ReadingWindow, RobotMemory, SeenFeatures


@given(st.integers(1, 12), st.lists(st.integers(0, 20), max_size=12))
def test_a_window_holds_the_newest_readings_at_its_end(size: int, counts: list[int]) -> None:
    stream = np.arange(2 * sum(counts), dtype=np.float32).reshape(-1, 2) + 1
    window, taken, buffer = ReadingWindow(size, 2), 0, None
    for count in counts:
        window.append(stream[taken : taken + count])
        taken += count
        newest = stream[max(0, taken - size) : taken]
        assert window.valid == len(newest)
        np.testing.assert_array_equal(window.values[size - len(newest) :], newest)
        assert not window.values[: size - len(newest)].any()
        assert buffer is None or window.values is buffer
        buffer = window.values


def test_a_stream_that_the_policy_has_not_is_passed_over() -> None:
    memory = RobotMemory((3, 0), (2, 1))
    readings = {"sensor": np.ones((2, 1026), np.float32), "state": np.ones((2, 1), np.float32)}
    memory.sense({"time": np.array([0.1]), **readings})
    assert memory.observation().keys() == {"state", "state_valid"}


def test_an_observation_is_a_copy_with_the_true_age() -> None:
    memory = RobotMemory((3, 2), (2, 1))
    memory.sense({"time": np.array([0.1]), "sensor": np.ones((2, 2), np.float32)})
    first = memory.observation()
    assert first.keys() == {"sensor", "sensor_valid", "state", "state_valid"}
    assert (first["sensor_valid"], first["state_valid"]) == (2, 0)
    memory.features = SeenFeatures(np.zeros((1, 4), np.float32), np.ones(1, np.bool_), 0.05)
    memory.sense({"time": np.array([0.4]), "state": np.ones((5, 1), np.float32)})
    second = memory.observation()
    np.testing.assert_allclose(second["feature_age"], 0.35, rtol=1e-6)
    assert second["state_valid"] == 2
    memory.sense({"time": np.array([0.5]), "sensor": np.full((3, 2), 9, np.float32)})
    assert second["sensor"].max() == 1
