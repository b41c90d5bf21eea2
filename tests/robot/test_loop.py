"""Which step of which chunk is played, what is due in a tick, when a robot stands still."""

from collections.abc import Iterator
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.config import Chunking
from pipeline.base.errors import ConfigError
from pipeline.robot.loop import ControlLoop, Executor, PlanGuide, soft_mask
from pipeline.robot.session import stack_guides

MODES = get_args(Chunking)
HORIZON = 8


def chunk_of(tick: int, name: float = 0.0, horizon: int = HORIZON) -> np.ndarray:
    """A chunk whose steps say the tick that they are for, and which chunk they are of."""
    return np.stack([tick + np.arange(horizon), np.full(horizon, name)], axis=1)


def take(executor: Executor, chunk: np.ndarray) -> None:
    """Observe, and plan the chunk at once."""
    executor.begin()
    executor.plan(chunk)


def play(executor: Executor, steps: int) -> list[float]:
    """The ticks that the next actions are for."""
    return [float(executor.next_action()[0]) for _ in range(steps)]


class TestDue:
    @pytest.mark.parametrize(("chunking", "execute"), [*zip(MODES, (1, 3, HORIZON), strict=True)])
    def test_it_is_before_the_first_chunk_and_every_so_many_steps(self, chunking, execute):
        executor, observed = Executor(chunking, execute, HORIZON), []
        for tick in range(20):
            if executor.due:
                take(executor, chunk_of(tick))
                observed.append(tick)
            assert not executor.due
            assert executor.next_action()[0] == tick
        assert observed == list(range(0, 20, execute))

    @pytest.mark.parametrize("execute", [0, 9])
    def test_more_steps_than_a_chunk_has_are_refused(self, execute: int) -> None:
        with pytest.raises(ConfigError, match=rf"rollout\.execute: expected 1 to 8.*{execute}"):
            Executor("none", execute, HORIZON)


@pytest.mark.parametrize("chunking", MODES)
class TestSteps:
    def test_a_chunk_used_up_gives_no_action_and_a_second_begin_replaces_the_first(self, chunking):
        executor = Executor(chunking, 2, HORIZON)
        with pytest.raises(AssertionError, match="begin"):
            executor.plan(chunk_of(0))
        with pytest.raises(AssertionError, match="no action at tick 0"):
            executor.next_action()
        take(executor, chunk_of(0))
        executor.begin()
        play(executor, 3)
        take(executor, chunk_of(3))
        executor.begin()
        assert play(executor, HORIZON) == list(range(3, 3 + HORIZON))
        executor.plan(chunk_of(3))
        assert executor.due
        with pytest.raises(AssertionError, match="no action at tick 11"):
            executor.next_action()

    def test_reset_forgets_the_episode(self, chunking: Chunking) -> None:
        executor = Executor(chunking, 1, HORIZON, [True, False])
        for _ in range(3):
            take(executor, chunk_of(100))
            play(executor, 1)
        executor.begin()
        executor.reset()
        assert executor.due and executor.begin() is None
        executor.plan(np.ones((HORIZON, 2)))
        assert play(executor, 2) == [1, 1]

    @given(st.lists(st.tuples(st.booleans(), st.integers(0, 3)), max_size=30))
    def test_whatever_the_delays_every_step_is_that_of_its_tick(self, chunking, turns):
        """Others drop as many steps as the computation is believed to have taken."""
        executor, tick = Executor(chunking, 1, HORIZON), 0
        take(executor, chunk_of(0))
        for again, delay in turns:
            for _ in range(1 + again):
                executor.begin()
            begun = tick
            assert play(executor, delay) == list(range(tick, tick + delay))
            tick += delay
            executor.plan(chunk_of(begun))
            assert play(executor, 1) == [tick]
            tick += 1


@pytest.mark.parametrize("chunking", MODES)
def test_temporal_averages_all_chunks_that_reach_a_tick_and_others_play_the_newest(chunking):
    """In closed form: the newest weighs most."""
    executor, horizon = Executor(chunking, 1, 3), 3
    names = [5.0, -1.0, 2.0, 8.0]
    for tick, name in enumerate(names):
        take(executor, chunk_of(tick, name, horizon))
        reach = names[max(0, tick - horizon + 1) : tick + 1]
        weights = [np.exp(0.2 * i) for i in range(len(reach))]
        mean = sum(w * n for w, n in zip(weights, reach, strict=True)) / sum(weights)
        expected = mean if chunking == "temporal" else name
        assert executor.next_action().tolist() == pytest.approx([tick, expected])


class TestMoving:
    """Channels that say how far to move: what counts is where a chunk leads to."""

    @staticmethod
    def executor(chunking: Chunking = "none", execute: int = 1) -> Executor:
        return Executor(chunking, execute, HORIZON, [True, False])

    @staticmethod
    def deltas(step: float, place: float = 7.0) -> np.ndarray:
        return np.tile(np.array([step, place], np.float32), (HORIZON, 1))

    @given(st.data(), st.sampled_from(["none", "rtc"]), st.integers(1, HORIZON))
    def test_a_chunk_in_time_is_played_as_it_is(self, data, chunking, execute):
        executor, steps = self.executor(chunking, execute), st.floats(-3, 3, width=32)
        for _ in range(4):
            chunk = np.array([[data.draw(steps), 7.0] for _ in range(HORIZON)], np.float32)
            take(executor, chunk)
            played = np.stack([executor.next_action() for _ in range(execute)])
            np.testing.assert_allclose(played, chunk[:execute], atol=1e-6)

    def test_a_late_chunk_leads_to_where_it_meant_to_and_the_guide_is_what_will_be_played(self):
        """What an older chunk moved meanwhile is not moved again."""
        executor = self.executor("rtc")
        take(executor, self.deltas(1.0))
        executor.next_action()
        executor.begin()
        assert play(executor, 3) == [1, 1, 1]
        executor.plan(self.deltas(-2.0, place=9.0))
        guide = executor.begin()
        # Its fourth step ends 8 below where it was asked for; the robot was sent 3 above that.
        assert guide is not None and guide.chunk[:2].tolist() == [[-11, 9], [-2, 9]]
        assert executor.next_action().tolist() == [-11, 9]
        assert executor.next_action().tolist() == [-2, 9]

    def test_ensembles_average_places(self) -> None:
        executor = self.executor("temporal")
        sent, plans = 0.0, []
        for step in (1.0, -1.0, 0.5, 0.0):
            take(executor, self.deltas(step))
            plans.append(sent + step * np.arange(1, HORIZON + 1))
            now = [plan[len(plans) - 1 - begun] for begun, plan in enumerate(plans)]
            place = np.average(now, weights=np.exp(0.2 * np.arange(len(now))))
            action = executor.next_action()
            assert action.tolist() == pytest.approx([place - sent, 7.0])
            sent = place

    def test_what_was_cut_off_is_made_up_for_but_not_where_a_channel_says_where_to_be(self) -> None:
        executor = Executor("none", 3, 4, (True, True, False))
        take(executor, np.array([[1, 1, 5], [1, 1, 6], [1, 1, 7], [1, 1, 8]], np.float32))
        assert executor.next_action().tolist() == [1, 1, 5]
        executor.sent([0.25, 1, 2])
        assert executor.next_action().tolist() == [1.75, 1, 6]
        executor.sent([1, 1, 6])
        assert executor.next_action().tolist() == [1.75, 1, 7]
        executor.sent([0.25, 0.25, 7])
        take(executor, np.ones((4, 3), np.float32))  # counts from where the robot was really sent
        assert executor.next_action().tolist() == [1, 1, 1]


class TestGuide:
    @staticmethod
    def under_way(execute: int = 3, played: int = 3) -> Executor:
        executor = Executor("rtc", execute, HORIZON)
        take(executor, chunk_of(0) + 1)
        play(executor, played)
        return executor

    @pytest.mark.parametrize(("played", "execute"), [(0, 3), (3, 5), (7, 1)])
    def test_it_is_the_rest_of_the_plan_and_what_the_plan_does_not_reach_weighs_nothing(
        self, played, execute
    ):
        """Zeros with weight would decode to the mean action."""
        executor = self.under_way(execute, played)
        guide = executor.begin()
        assert np.array_equal(guide.chunk[: HORIZON - played], chunk_of(played)[: 8 - played] + 1)
        ends = HORIZON - max(played, execute)
        assert (guide.weight[:ends] > 0).all() and (guide.weight[ends:] == 0).all()
        assert (guide.chunk[guide.weight > 0] > 0).all()
        guide.chunk[:] = -1
        assert play(executor, 1) == [played + 1], "the plan stays as it is"

    def test_as_many_steps_are_held_as_any_of_the_last_ten_chunks_took(self) -> None:
        executor, held = self.under_way(execute=1), []
        for delay in (2, 1, *[0] * 11):
            guide = executor.begin()
            held.append(int((guide.weight == 1).sum()))
            play(executor, delay)
            executor.plan(chunk_of(0))
        assert held == [0, *[2] * 10, 1, 0]

    def test_there_is_none_in_other_modes_before_a_plan_and_at_its_end(self) -> None:
        for chunking in MODES:
            executor = Executor(chunking, 3, HORIZON)
            assert executor.begin() is None
            executor.plan(chunk_of(0))
            assert (executor.begin() is None) == (chunking != "rtc")
        assert self.under_way(played=HORIZON).begin() is None
        assert self.under_way(execute=HORIZON, played=4).begin() is None

    def test_the_mask_is_that_of_the_paper(self) -> None:
        """Eq. 5 written out, H = 10, s = 3, d = 2."""
        c = [5 / 6, 4 / 6, 3 / 6, 2 / 6, 1 / 6]
        falling = [x * (np.e**x - 1) / (np.e - 1) for x in c]
        expected = [1, 1, *falling, 0, 0, 0]
        np.testing.assert_allclose(soft_mask(10, 2, 7), expected, rtol=1e-6)
        assert soft_mask(10, 9, 4).tolist() == [1] * 4 + [0] * 6, "no more than the overlap"

    def test_robots_without_a_plan_weigh_nothing_in_a_batch(self) -> None:
        plan = PlanGuide(np.full((4, 2), 3, np.float32), np.full(4, 0.5, np.float32))
        guide = stack_guides([None, plan, None], torch.device("cpu"))
        assert guide is not None and guide.chunk.shape == (3, 4, 2)
        assert guide.weight.tolist() == [[0] * 4, [0.5] * 4, [0] * 4]
        assert guide.chunk.sum(dim=(1, 2)).tolist() == [0, 24, 0]
        assert stack_guides([None, None], torch.device("cpu")) is None


def run(loop: ControlLoop, ticks: int, latency: int = 0) -> Iterator[tuple[bool, bool, float]]:
    """Of every tick: whether a pass began, which ends `latency` ticks later, whether a chunk was
    asked for, and the tick that the action is meant for, -1 without one."""
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
            loop.plan(chunk_of(tick))
        action = loop.action()
        yield due, asked, -1 if action is None else float(action[0])


@pytest.mark.parametrize(
    ("execute", "latency", "passes", "asked"),
    [
        (1, 0, [0, 3, 6, 9], [*range(12)]),
        (3, 0, [0, 3, 6, 9], [0, 3, 6, 9]),
        (1, 5, [0, 5, 10], [*range(5, 12)]),  # a slow model is asked again when it is free
    ],
)
def test_the_model_looks_every_third_tick_and_the_head_answers_as_often_as_it_is_asked(
    execute, latency, passes, asked
):
    """A robot stands still until its first chunk is there; the next episode begins with nothing."""
    loop = ControlLoop(Executor("none", execute, HORIZON), 3, True)
    for _ in range(2):
        loop.reset()
        log = [*run(loop, 12, latency)]
        assert [tick for tick, (began, *_) in enumerate(log) if began] == passes
        assert [tick for tick, (_, wanted, _) in enumerate(log) if wanted] == asked
        assert [tick for *_, tick in log] == [*[-1] * latency, *range(latency, 12)]
