"""The gymnasium environment: its contract, its clocks, its frames."""

import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from pipeline.simulation.environment import InsertionEnvironment
from pipeline.simulation.insertion import MAX_TICKS, TICK_S
from pipeline.simulation.rendering import VIEWS, photograph, render

STILL = np.zeros(7, np.float32)


@pytest.mark.parametrize("cameras", [True, False])
def test_gymnasiums_checker_passes(cameras: bool) -> None:
    with warnings.catch_warnings():
        # It recommends actions in [-1, 1], which ours are not: millimetres and degrees.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized space.*")
        warnings.filterwarnings("ignore", message=".*alternative render modes.*")
        check_env(InsertionEnvironment(cameras=cameras, render_mode="rgb_array"))


def test_the_demonstrator_succeeds_and_is_rewarded_once() -> None:
    environment = InsertionEnvironment("full", cameras=False)
    environment.reset(seed=11)
    rewards, ended = [], False
    while not ended:
        action = environment.insertion.expert_action()
        _, reward, ended, truncated, info = environment.step(action)
        assert not truncated
        rewards.append(reward)
    assert sum(rewards) == rewards[-1] == 1.0 and info["reason"] == "inserted"


def test_time_that_is_up_truncates() -> None:
    environment = InsertionEnvironment("full", cameras=False)
    environment.reset(seed=1)
    ticks, over = 1, False
    while not over:
        _, _, terminated, over, info = environment.step(STILL)
        ticks += 1
        assert not terminated
    assert ticks == MAX_TICKS and info == info | {
        "success": False,
        "reason": "time is up before a puncture",
    }


def test_frames_are_those_taken_last() -> None:
    environment = InsertionEnvironment("moved")
    observation, info = environment.reset(seed=4)
    ages = []
    for _ in range(30):
        now = float(observation["time"][0])
        assert observation["sensor_time"][-1] == pytest.approx(now)
        assert observation["state_time"][-1] == pytest.approx(now)
        ages += [now - time for time in info["frame_time"].values()]
        for view, (time, frame) in environment.frames().items():
            np.testing.assert_array_equal(frame, observation[f"images/{view}"])
            assert time == info["frame_time"][view]
            scene = environment.insertion.scene(time)
            assert np.abs(frame.astype(int) - render(view, scene).astype(int)).mean() < 4
        observation, *_, info = environment.step(environment.insertion.expert_action())
    assert min(ages) >= 0 and max(ages) < 1.3 * TICK_S and np.std(ages) > 0.01


def test_a_photograph_has_noise_and_is_the_same_again() -> None:
    environment = InsertionEnvironment(cameras=False)
    environment.reset(seed=2)
    for view in VIEWS:
        first = photograph(view, environment.insertion, 0.05)
        np.testing.assert_array_equal(first, photograph(view, environment.insertion, 0.05))
        again = photograph(view, environment.insertion, 0.051)
        clean = render(view, environment.insertion.scene(0.05))
        assert not np.array_equal(first, again)
        assert 1 < np.std(first.astype(int) - clean.astype(int)) < 3


def test_seeds_differ_and_none_draws_one() -> None:
    environment = InsertionEnvironment(cameras=False)
    first = environment.reset(seed=1)[0]["state"]
    assert not np.array_equal(first, environment.reset(seed=2)[0]["state"])
    drawn = environment.reset()[0]["state"]
    assert not np.array_equal(drawn, environment.reset()[0]["state"])


def test_what_makes_no_sense_is_refused() -> None:
    wrong: Any = "hard"
    with pytest.raises(ValueError, match="depth, full, moved, found 'hard'"):
        InsertionEnvironment(wrong)
    with pytest.raises(ValueError, match="found 'hard'"):
        InsertionEnvironment(action_rotation=wrong)
    environment = InsertionEnvironment(cameras=False)
    with pytest.raises(ResetNeeded):
        environment.step(STILL)
    environment.reset(seed=1)
    environment.step([0.0] * 7)
    while not environment.insertion.finished:
        environment.step(environment.insertion.expert_action())
    with pytest.raises(ResetNeeded):
        environment.step(STILL)
