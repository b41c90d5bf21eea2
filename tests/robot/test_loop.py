"""One robot's loop: what is due when, how old features are, and when the robot stands still."""

import numpy as np
import pytest

from pipeline.base.config import TrainHeadParams
from pipeline.policy.observation import PolicyShape
from pipeline.robot.loop import ControlLoop, LoopTiming, SafeStop
from pipeline.robot.memory import SeenFeatures

HORIZON, ACTION = 4, 2
SHAPE = PolicyShape(1, 3, 2, 1, ACTION, ("other",) * ACTION)
PARAMS = TrainHeadParams(horizon=HORIZON, sensor_window=3, state_window=2)


def make_loop(latency_s: float = 0.0, execute: int = 1, uses_features: bool = True) -> ControlLoop:
    return ControlLoop(
        PARAMS, SHAPE, LoopTiming(3, latency_s, execute, "none", (False, False)), uses_features
    )


def seen(time_s: float) -> SeenFeatures:
    return SeenFeatures(
        np.full((1, 3), time_s, np.float32), np.ones(1, np.bool_), np.array([time_s])
    )


def chunk_of(tick: int) -> np.ndarray:
    """A chunk whose steps say the tick that they are for."""
    return np.repeat(tick + np.arange(HORIZON, dtype=np.float32)[:, None], ACTION, axis=1)


def run(loop: ControlLoop, ticks: int) -> list[tuple[bool, bool, float | None, float]]:
    """Of every tick: whether a pass began, whether a chunk was asked for, the features' age, the
    first channel of the action, which says the tick that it is meant for."""
    log = []
    for tick in range(ticks):
        now = 0.1 * (tick + 1)
        loop.sense({"time": np.array([now])})
        if began := loop.frames_due:
            loop.see(seen(now - 0.02))
        if asked := loop.chunk_due:
            loop.executor.begin()
            loop.plan(chunk_of(tick + 1))
        age = loop.memory.observation().get("feature_age")
        log.append((began, asked, None if age is None else float(age), float(loop.action()[0])))
    return log


def test_the_model_is_asked_every_third_tick_and_the_head_every_tick() -> None:
    log = run(make_loop(), 7)
    assert [began for began, *_ in log] == [True, False, False] * 2 + [True]
    assert all(asked for _, asked, *_ in log)
    ages = [age for *_, age, _ in log]
    np.testing.assert_allclose(ages, [0.02, 0.12, 0.22, 0.02, 0.12, 0.22, 0.02], atol=1e-6)


def test_a_chunk_is_played_for_as_many_steps_as_are_executed() -> None:
    log = run(make_loop(execute=3), 7)
    assert [asked for _, asked, *_ in log] == [True, False, False] * 2 + [True]
    assert [action for *_, action in log] == [1, 2, 3, 4, 5, 6, 7]


def test_a_slow_model_is_asked_again_when_it_is_free_and_its_features_are_as_old_as_they_are() -> (
    None
):
    log = run(make_loop(latency_s=0.5), 12)
    assert [tick for tick, (began, *_) in enumerate(log) if began] == [0, 5, 10]
    ages = [age for *_, age, _ in log]
    assert ages[:5] == [None] * 5
    np.testing.assert_allclose(
        np.array(ages[5:], float), [0.52, 0.62, 0.72, 0.82, 0.92, 0.52, 0.62], atol=1e-6
    )


def test_a_robot_stands_still_until_the_first_features_are_there() -> None:
    log = run(make_loop(latency_s=0.25), 6)
    assert [asked for _, asked, *_ in log] == [False] * 3 + [True] * 3
    assert [action for *_, action in log] == [0, 0, 0, 4, 5, 6]
    blind = run(make_loop(latency_s=0.25, uses_features=False), 2)
    assert blind == [(False, True, None, 1.0), (False, True, None, 2.0)]


def test_steps_played_while_a_chunk_is_computed_are_skipped_and_no_others() -> None:
    """A head that takes two ticks, after a first chunk that took as long and played nothing."""
    loop = make_loop(execute=2, uses_features=False)
    loop.sense({"time": np.array([0.1])})
    loop.executor.begin()
    loop.sense({"time": np.array([0.3])})  # the warm-up: time goes by, no step is played
    loop.plan(chunk_of(1))
    played, asked = [], None
    for tick in range(1, 12):
        loop.sense({"time": np.array([0.1 * tick + 0.3])})
        if asked is not None and tick - asked == 2:
            loop.plan(chunk_of(asked))
            asked = None
        if asked is None and loop.chunk_due:
            loop.executor.begin()
            asked = tick
        played.append(float(loop.action()[0]))
    assert played == list(range(1, 12))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_no_number_is_a_safe_stop(bad: float) -> None:
    loop = make_loop(uses_features=False)
    loop.sense({"time": np.array([0.1])})
    loop.executor.begin()
    chunk = np.zeros((HORIZON, ACTION), np.float32)
    chunk[-1, 1] = bad
    with pytest.raises(SafeStop, match="not a number"):
        loop.plan(chunk)
