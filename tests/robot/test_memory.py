"""Windows of the newest readings, and what a policy is given of them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.robot.memory import ReadingWindow, RobotMemory, SeenFeatures, WindowSize


@given(st.integers(1, 12), st.lists(st.integers(0, 20), max_size=12))
def test_a_window_holds_the_newest_readings_at_its_end(size: int, counts: list[int]) -> None:
    stream = np.arange(2 * sum(counts), dtype=np.float32).reshape(-1, 2) + 1
    window, taken, buffer = ReadingWindow(WindowSize(size, 2, None)), 0, None
    for count in counts:
        time_s = np.arange(taken, taken + count, dtype=np.float64)
        window.append(stream[taken : taken + count], time_s)
        taken += count
        newest = stream[max(0, taken - size) : taken]
        values, valid, ages = window.at(taken + 0.5)
        assert valid == len(newest)
        np.testing.assert_array_equal(values[size - valid :], newest)
        np.testing.assert_array_equal(ages[size - valid :], np.arange(valid, 0, -1) + 0.5)
        assert not values[: size - valid].any()
        assert not ages[: size - valid].any()
        assert buffer is None or window.values is buffer
        buffer = window.values


def test_what_is_older_than_the_window_is_no_reading_of_it() -> None:
    window = ReadingWindow(WindowSize(5, 1, 0.3))
    window.append(np.ones((4, 1), np.float32), np.array([0.1, 0.2, 0.3, 0.4]))
    values, valid, ages = window.at(0.5)
    assert valid == 3  # one is exactly as old as the window, but for rounding
    np.testing.assert_allclose(ages, [0, 0, 0.3, 0.2, 0.1], atol=1e-7)
    assert values.ravel().tolist() == [0, 0, 1, 1, 1]
    assert window.at(9.0)[1] == 0  # the stream has stalled


def test_a_stream_that_the_policy_has_not_is_passed_over() -> None:
    memory = RobotMemory(WindowSize(3, 0, None), WindowSize(2, 1, None))
    readings = {"sensor": np.ones((2, 1026), np.float32), "state": np.ones((2, 1), np.float32)}
    readings |= {"sensor_time": np.zeros(2), "state_time": np.zeros(2)}
    memory.sense({"time": np.array([0.1]), **readings})
    assert memory.observation().keys() == {"state", "state_valid", "state_age"}


def sensed(time_s: float, **streams: np.ndarray) -> dict[str, np.ndarray]:
    """What came by now, all of it just now."""
    times = {f"{name}_time": np.full(len(values), time_s) for name, values in streams.items()}
    return {"time": np.array([time_s]), **streams, **times}


def test_an_observation_is_a_copy_with_the_true_ages() -> None:
    memory = RobotMemory(WindowSize(3, 2, None), WindowSize(2, 1, None))
    memory.sense(sensed(0.1, sensor=np.ones((2, 2), np.float32)))
    first = memory.observation()
    streams = ("sensor", "state")
    assert first.keys() == {f"{name}{what}" for name in streams for what in ("", "_valid", "_age")}
    assert (first["sensor_valid"], first["state_valid"]) == (2, 0)
    frames = np.array([0.05, np.nan, 0.0])
    memory.features = SeenFeatures(np.zeros((1, 4), np.float32), np.ones(1, np.bool_), frames)
    memory.sense(sensed(0.4, state=np.ones((5, 1), np.float32)))
    second = memory.observation()
    np.testing.assert_allclose(second["feature_age"], 0.35, rtol=1e-6)
    np.testing.assert_allclose(second["view_age"], [0.35, np.nan, 0.4], rtol=1e-6)
    np.testing.assert_allclose(second["sensor_age"], [0, 0.3, 0.3], rtol=1e-6)
    assert second["state_valid"] == 2
    memory.sense(sensed(0.5, sensor=np.full((3, 2), 9, np.float32)))
    assert second["sensor"].max() == 1
