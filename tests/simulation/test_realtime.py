"""The simulated arm in real time: its clock keeps pace with ours at any rate."""

import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from pipeline.simulation.environment import InsertionEnvironment, SimulatedRobot
from pipeline.simulation.insertion import INSERTED, TIME_IS_UP
from pipeline.simulation.rendering import VIEWS

STILL = np.zeros(7)


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


def hz_of(robot: SimulatedRobot) -> float:
    return robot._hz


def test_an_action_is_a_tick_and_tells_the_readings_of_the_simulation(
    robot: SimulatedRobot, clock: Clock
) -> None:
    environment = InsertionEnvironment(cameras=False)
    readings, _ = environment.reset(seed=3)
    for tick in range(3):
        # A tick begins a little early or late; which it is changes nothing.
        clock.now_s = 1000.0 + (tick + (0.0, -0.04, 0.9)[tick]) / hz_of(robot)
        observed = robot.observe()
        assert observed["time"][0] == pytest.approx(tick / hz_of(robot))
        np.testing.assert_array_equal(observed["state"], readings["state"])
        np.testing.assert_array_equal(observed["sensor"], readings["sensor"])
        assert observed["state_time"][-1] == pytest.approx(observed["time"][0])
        # Ten readings a tick, whatever a tick takes.
        assert np.diff(observed["state_time"]) == pytest.approx(0.1 / hz_of(robot))
        action = np.array([0.1 * tick, 0, -0.1, 0, 0, 0, 1])
        robot.act(action)
        readings, *_ = environment.step(action)


@pytest.mark.parametrize(("waited", "ticks"), [(0.9, 0), (1.96, 2), (2.2, 2)])
def test_ticks_without_an_action_pass_all_the_same(
    robot: SimulatedRobot, clock: Clock, waited: float, ticks: int
) -> None:
    first = robot.observe()
    clock.now_s += waited / hz_of(robot)
    later = robot.observe()
    assert later["time"] - first["time"] == pytest.approx(ticks / hz_of(robot))
    assert len(later.get("state", ())) == 10 * ticks


def test_frames_follow_and_say_when_they_were_taken(robot: SimulatedRobot) -> None:
    first = robot.frames()
    assert set(first) == set(VIEWS)
    for _ in range(4):
        robot.observe()
        robot.act(STILL)
    until = time.monotonic() + 10
    while robot.frames() == first or robot.frames()["View1"][0] <= first["View1"][0]:
        assert time.monotonic() < until
        time.sleep(0.005)
    now = robot.observe()["time"][0]
    assert all(taken <= now + 1e-9 for taken, _ in robot.frames().values())


def finish(robot: SimulatedRobot) -> None:
    while not robot._environment.insertion.finished:
        robot.act(robot._environment.insertion.expert_action())


def test_the_end_of_an_episode_ends_the_run(robot: SimulatedRobot) -> None:
    robot.observe()
    finish(robot)
    robot.act(STILL)
    assert robot.outcome == INSERTED
    assert robot.observe()["ended"] == INSERTED


def test_an_episode_that_ends_while_nobody_acts_ends_the_run_too(clock: Clock) -> None:
    with closing(SimulatedRobot(hz=1000.0, seed=3, clock=clock)) as robot:
        robot.observe()
        clock.now_s += 0.13  # all its 120 ticks
        assert robot.observe()["ended"] == robot.outcome == f"{TIME_IS_UP} before a puncture"


def test_its_clock_is_the_monotonic_one() -> None:
    with closing(SimulatedRobot(hz=1000.0, seed=3)) as robot:
        robot.observe()
        began_s = time.monotonic()
        while robot.observe()["time"] < 0.02:
            pass
        assert time.monotonic() - began_s > 0.018


def test_a_robot_that_was_stopped_does_not_move(robot: SimulatedRobot) -> None:
    robot.observe()
    robot.stop("by hand")
    robot.act(np.array([1.0, 0, 0, 0, 0, 0, 1]))
    assert robot.stopped == "by hand" and robot.outcome is None
    assert robot._environment.insertion.time_s == pytest.approx(0.1)
