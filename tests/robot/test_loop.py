"""One robot's loop: what is due when, and when the robot stands still."""

import numpy as np
import pytest

from pipeline.robot.chunking import Executor
from pipeline.robot.loop import ControlLoop, SafeStop, StopKind

HORIZON, ACTION = 4, 2


def make_loop(execute: int = 1, uses_features: bool = True) -> ControlLoop:
    return ControlLoop(Executor("none", execute, HORIZON, (False, False)), 3, uses_features)


def chunk_of(tick: int) -> np.ndarray:
    """A chunk whose steps say the tick that they are for."""
    return np.repeat(tick + np.arange(HORIZON, dtype=np.float32)[:, None], ACTION, axis=1)


def run(loop: ControlLoop, ticks: int, latency: int = 0) -> list[tuple[bool, bool, float | None]]:
    """Of every tick: whether a pass began, which ends `latency` ticks later, whether a chunk was
    asked for, and the first channel of the action, which says the tick that it is meant for."""
    log: list[tuple[bool, bool, float | None]] = []
    ends, seen = -1, False
    for tick in range(ticks):
        loop.begin_tick()
        if tick == ends:
            loop.pass_ended()
            seen = True
        if due := loop.frames_due:
            loop.pass_began()
            ends = tick + latency
        if tick == ends:
            loop.pass_ended()
            seen = True
        if asked := seen and loop.chunk_due:
            loop.ask()
            loop.plan(chunk_of(tick + 1))
        action = loop.action()
        log.append((due, asked, None if action is None else float(action[0])))
    return log


def test_the_model_is_asked_every_third_tick_and_the_head_every_tick() -> None:
    log = run(make_loop(), 7)
    assert [began for began, *_ in log] == [True, False, False] * 2 + [True]
    assert all(asked for _, asked, _ in log)


def test_a_chunk_is_played_for_as_many_steps_as_are_executed() -> None:
    log = run(make_loop(execute=3), 7)
    assert [asked for _, asked, _ in log] == [True, False, False] * 2 + [True]
    assert [action for *_, action in log] == [1, 2, 3, 4, 5, 6, 7]


def test_a_slow_model_is_asked_again_when_it_is_free() -> None:
    log = run(make_loop(), 12, latency=5)
    assert [tick for tick, (began, *_) in enumerate(log) if began] == [0, 5, 10]


def test_a_policy_without_features_needs_no_frames() -> None:
    loop = make_loop(uses_features=False)
    loop.begin_tick()
    assert not loop.frames_due and loop.chunk_due


def test_what_was_refused_is_asked_again_with_frames() -> None:
    loop = make_loop()
    loop.begin_tick()
    loop.pass_began()
    loop.ask()
    loop.begin_tick()
    loop.refused()
    assert loop.frames_due and loop.chunk_due


def test_a_refusal_leaves_a_pass_of_an_earlier_question_alone() -> None:
    loop = make_loop()
    loop.begin_tick()
    loop.pass_began()
    loop.ask()
    loop.plan(chunk_of(0))
    for _ in range(3):
        loop.action()
        loop.begin_tick()
        assert loop.chunk_due
        loop.ask()
        loop.refused()
    assert not loop.frames_due, "the pass is still under way"
    loop.pass_ended()
    assert loop.frames_due


def test_a_robot_stands_still_until_its_first_chunk_is_there() -> None:
    log = run(make_loop(), 6, latency=3)
    assert [asked for _, asked, _ in log] == [False] * 3 + [True] * 3
    assert [action for *_, action in log] == [None, None, None, 4, 5, 6]


def test_steps_played_while_a_chunk_is_computed_are_skipped_and_no_others() -> None:
    """A head that takes two ticks, after a first chunk that took as long and played nothing."""
    loop = make_loop(execute=2, uses_features=False)
    loop.begin_tick()
    loop.ask()
    loop.begin_tick()  # the warm-up: time goes by, no step is played
    loop.plan(chunk_of(1))
    played, asked = [], None
    for tick in range(1, 12):
        loop.begin_tick()
        if asked is not None and tick - asked == 2:
            loop.plan(chunk_of(asked))
            asked = None
        if asked is None and loop.chunk_due:
            loop.ask()
            asked = tick
        action = loop.action()
        assert action is not None
        played.append(float(action[0]))
    assert played == list(range(1, 12))


def test_a_plan_that_is_used_up_is_a_safe_stop() -> None:
    loop = make_loop(uses_features=False)
    loop.begin_tick()
    loop.ask()
    loop.plan(chunk_of(1))
    for _ in range(HORIZON):
        loop.action()
    with pytest.raises(SafeStop) as stopped:
        loop.action()
    assert stopped.value.kind == StopKind.NO_CHUNK


def test_the_next_episode_begins_with_nothing() -> None:
    loop = make_loop()
    first = run(loop, 5)
    loop.reset()
    assert run(loop, 5) == first


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_no_number_is_a_safe_stop(bad: float) -> None:
    loop = make_loop(uses_features=False)
    loop.begin_tick()
    loop.ask()
    chunk = np.zeros((HORIZON, ACTION), np.float32)
    chunk[-1, 1] = bad
    with pytest.raises(SafeStop, match="not a number") as stopped:
        loop.plan(chunk)
    assert stopped.value.kind == StopKind.NOT_A_NUMBER
