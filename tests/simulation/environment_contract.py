"""What every environment must keep, so that a policy can be rolled out in it."""

import numpy as np
import pytest


class EnvironmentContract:
    """Subclass it with a fixture `environment`, which gives a `RobotEnvironment`."""

    def test_the_same_seed_and_actions_are_the_same_episode(self, environment) -> None:
        """Whatever was played before: each way of running a policy meets the same episodes."""
        played = []
        for seed in (7, 8, 7):
            readings, _ = environment.reset(seed=seed)
            rows = [readings]
            for _ in range(5):
                rows.append(environment.step(environment.still())[0])
            shot = environment.frames()
            played.append((rows, {view: frame for view, (_, frame) in shot.items()}))
        first, other, again = played
        for row, same in zip(first[0], again[0], strict=True):
            np.testing.assert_equal(row, same)
        np.testing.assert_equal(first[1], again[1])
        assert any(not np.array_equal(frame, other[1][view]) for view, frame in first[1].items())

    def test_observations_have_the_streams_of_the_robot(self, environment) -> None:
        robot = environment.robot
        readings, _ = environment.reset(seed=3)
        for _ in range(3):
            before_s = float(readings["time"][0])
            readings, *_ = environment.step(environment.still())
            now_s = float(readings["time"][0])
            assert now_s == pytest.approx(before_s + 1 / robot.hz)
            for name in ("state", "sensor"):
                channels = robot.streams[name]
                assert (name in readings) == (channels is not None)
                if channels is not None:
                    times = readings[f"{name}_time"]
                    assert readings[name].shape == (len(times), len(channels.names))
                    assert len(channels.names) == len(channels.units)
                    assert before_s - 1e-9 < times[0] and times[-1] <= now_s + 1e-9
        assert environment.action_space.shape == (len(robot.action.names),)

    def test_frames_are_those_of_the_views_and_no_newer_than_now(self, environment) -> None:
        readings, _ = environment.reset(seed=3)
        shots = environment.frames()
        assert tuple(shots) == environment.robot.views
        assert environment.frame_times() == {view: time_s for view, (time_s, _) in shots.items()}
        for time_s, frame in shots.values():
            assert 0 <= time_s <= readings["time"][0] + 1e-9
            assert frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3
