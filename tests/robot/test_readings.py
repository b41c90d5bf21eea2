"""Windows of the newest readings, and what a policy is given of them."""

from dataclasses import asdict

import numpy as np
import pytest

from pipeline.robot.readings import ReadingWindow, RobotMemory, SeenFeatures
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows


def sensed(time_s: float, **streams: np.ndarray) -> dict[str, np.ndarray]:
    """What came by now, all of it just now."""
    times = {f"{name}_time": np.full(len(values), time_s) for name, values in streams.items()}
    return {"time": np.array([time_s]), **streams, **times}


def test_an_observation_is_a_copy_with_the_true_ages() -> None:
    memory = RobotMemory({"sensor": ReadingWindow(3, 2, None), "state": ReadingWindow(2, 1, None)})
    unknown = np.ones((2, 3), np.float32)  # a stream that the policy does not have
    memory.sense(sensed(0.1, sensor=np.ones((2, 2), np.float32), lidar=unknown))
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


@pytest.mark.parametrize("oldest_s", [None, 0.03, 0.05, 0.5])
def test_a_robot_sees_what_training_sees_of_the_same_readings(tiny_store, tmp_path, oldest_s):
    """At every tick of an episode that is felt reading by reading; a window is as old as a whole
    number of readings, but for rounding."""
    store = FeatureStore.open(tiny_store(tmp_path))
    store.array("tick/time")[:] += 0.1  # of the map in memory alone: no reading is of the future
    windows = Windows(4, 6, 5, oldest_s, oldest_s, feature_history=3)
    memory = RobotMemory(
        {
            "sensor": ReadingWindow(windows.sensor_window, store.sensor_channels, oldest_s),
            "state": ReadingWindow(windows.state_window, store.state_dim, oldest_s),
        },
        windows.feature_history,
    )
    episode, row = store.episodes[1], store.array("tick/vl_row")
    felt = {"sensor": episode.readings.start, "state": episode.states.start}
    counts: set[int] = set()
    for tick in episode.ticks:
        now_s = store.array("tick/time")[tick]
        for stream, start in felt.items():
            felt[stream] = int(store.array(f"tick/{stream}_end")[tick])
            for reading in range(start, felt[stream]):
                once = slice(reading, reading + 1)
                values = store.array(f"{stream}/values")[once]
                time_s = store.array(f"{stream}/time")[once]
                memory.sense({"time": time_s, stream: values, f"{stream}_time": time_s})
        memory.sense({"time": np.array([now_s])})
        trained = store.gather([tick], **asdict(windows))
        if tick == episode.ticks.start or row[tick] != row[tick - 1]:
            new = store.gather([tick])
            frame_time = store.array("vl/frame_time")[row[tick]]
            memory.features = SeenFeatures(
                new.features[0].numpy(), new.slot_valid[0].numpy(), frame_time
            )
        seen = memory.observation()
        assert seen.keys() | {"action", "action_valid"} == vars(trained).keys()
        for name, value in seen.items():
            np.testing.assert_array_equal(value, vars(trained)[name][0].numpy(), err_msg=name)
        counts.add(int(seen["state_valid"]))
    assert counts == {None: {4, 5}, 0.03: {1}, 0.05: {2}, 0.5: {4, 5}}[oldest_s]
