"""The gymnasium environment: its contract, its clocks, its frames; and as a robot in real time."""

import warnings
from collections.abc import Iterator
from contextlib import closing
from queue import SimpleQueue

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from pipeline.simulation.environment import InsertionEnvironment, SimulatedRobot
from pipeline.simulation.insertion import INSERTED, MAX_TICKS, TICK_S, TIME_IS_UP
from pipeline.simulation.rendering import VIEWS, render
from tests.simulation.environment_contract import EnvironmentContract

STILL = np.zeros(7, np.float32)


class TestPhantom(EnvironmentContract):
    @pytest.fixture
    def environment(self) -> InsertionEnvironment:
        return InsertionEnvironment()


def test_gymnasiums_checker_passes() -> None:
    with warnings.catch_warnings():
        # It recommends actions in [-1, 1], which ours are not: millimetres and degrees.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized space.*")
        warnings.filterwarnings("ignore", message=".*alternative render modes.*")
        check_env(InsertionEnvironment())


def test_the_demonstrator_succeeds_and_is_rewarded_once() -> None:
    environment = InsertionEnvironment("full")
    environment.reset(seed=11)
    rewards, ended = [], False
    while not ended:
        action = environment.insertion.expert_action()
        _, reward, ended, truncated, info = environment.step(action)
        assert not truncated
        rewards.append(reward)
    assert sum(rewards) == rewards[-1] == 1.0 and info["reason"] == "inserted"


def test_time_that_is_up_truncates() -> None:
    environment = InsertionEnvironment("full")
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
    observation, _ = environment.reset(seed=4)
    ages = []
    for _ in range(30):
        now = float(observation["time"][0])
        assert observation["sensor_time"][-1] == pytest.approx(now)
        assert observation["state_time"][-1] == pytest.approx(now)
        for view, (taken_s, frame) in environment.frames().items():
            ages.append(now - taken_s)
            scene = environment.insertion.scene(taken_s)
            assert np.abs(frame.astype(int) - render(view, scene).astype(int)).mean() < 4
        observation = environment.step(environment.insertion.expert_action())[0]
    assert min(ages) >= 0 and max(ages) < 1.3 * TICK_S and np.std(ages) > 0.01


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(ValueError, match="depth, full, moved, found 'hard'"):
        InsertionEnvironment("hard")
    with pytest.raises(ValueError, match="found 'hard'"):
        InsertionEnvironment(action_rotation="hard")
    environment = InsertionEnvironment()
    drawn = [environment.reset(seed=seed)[0]["state"] for seed in (1, 2, None, None)]
    assert len({state.tobytes() for state in drawn}) == 4, "None draws a seed"
    environment = InsertionEnvironment()
    with pytest.raises(ResetNeeded):
        environment.step(STILL)
    environment.reset(seed=1)
    environment.step([0.0] * 7)
    while not environment.insertion.finished:
        environment.step(environment.insertion.expert_action())
    with pytest.raises(ResetNeeded):
        environment.step(STILL)


class Clock:
    """Stands until it is set."""

    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture(params=[10.0, 50.0])
def robot(request: pytest.FixtureRequest, clock: Clock) -> Iterator[SimulatedRobot]:
    with closing(SimulatedRobot(hz=request.param, seed=3, clock=clock)) as made:
        yield made


def test_an_action_is_a_tick_and_tells_the_readings_of_the_simulation(robot, clock):
    environment = InsertionEnvironment()
    readings, _ = environment.reset(seed=3)
    for tick in range(3):
        # A tick begins a little early or late; which it is changes nothing.
        clock.now_s = 1000.0 + (tick + (0.0, -0.04, 0.9)[tick]) / robot._hz
        observed = robot.observe()
        assert observed["time"][0] == pytest.approx(tick / robot._hz)
        np.testing.assert_array_equal(observed["state"], readings["state"])
        np.testing.assert_array_equal(observed["sensor"], readings["sensor"])
        assert observed["state_time"][-1] == pytest.approx(observed["time"][0])
        # Ten readings a tick, whatever a tick takes.
        assert np.diff(observed["state_time"]) == pytest.approx(0.1 / robot._hz)
        action = np.array([0.1 * tick, 0, -0.1, 0, 0, 0, 1])
        robot.act(action)
        readings, *_ = environment.step(action)


@pytest.mark.parametrize(("waited", "ticks"), [(0.9, 0), (1.96, 2), (2.2, 2)])
def test_ticks_without_an_action_pass_all_the_same(robot, clock, waited, ticks):
    first = robot.observe()
    clock.now_s += waited / robot._hz
    later = robot.observe()
    assert later["time"] - first["time"] == pytest.approx(ticks / robot._hz)
    assert len(later.get("state", ())) == 10 * ticks


def test_frames_follow_and_say_when_they_were_taken(robot: SimulatedRobot) -> None:
    first, taken, began = robot.frames(), robot._taken, SimpleQueue[None]()
    robot._taken = lambda: (began.put(None), taken())[1]
    robot.observe()
    for _ in range(2):  # once the second look begins, the first is there
        robot.act(STILL)
        began.get(timeout=60)
    newest, now = robot.frames(), robot.observe()["time"][0]
    assert set(first) == set(newest) == set(VIEWS)
    for view, (taken_s, _) in newest.items():
        assert first[view][0] <= taken_s <= now + 1e-9
    assert any(newest[view][0] > first[view][0] for view in VIEWS)


def test_the_end_of_an_episode_ends_the_run(robot: SimulatedRobot) -> None:
    robot.observe()
    while not robot._environment.insertion.finished:
        robot.act(robot._environment.insertion.expert_action())
    robot.act(STILL)
    assert robot.observe()["ended"] == robot.outcome == INSERTED


def test_an_episode_that_ends_while_nobody_acts_ends_the_run_too(clock: Clock) -> None:
    with closing(SimulatedRobot(hz=1000.0, seed=3, clock=clock)) as robot:
        robot.observe()
        clock.now_s += 0.13  # all its 120 ticks
        assert robot.observe()["ended"] == robot.outcome == f"{TIME_IS_UP} before a puncture"


def test_a_robot_that_was_stopped_does_not_move(robot: SimulatedRobot) -> None:
    robot.observe()
    robot.stop("by hand")
    robot.act(np.array([1.0, 0, 0, 0, 0, 0, 1]))
    assert robot.stopped == "by hand" and robot.outcome is None
    assert robot._environment.insertion.time_s == pytest.approx(0.1)
