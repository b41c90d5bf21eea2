"""Which step of which chunk is played at a tick, and what of a plan guides the next chunk."""

import subprocess
import sys
from itertools import product
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.config import Chunking
from pipeline.base.errors import ConfigError
from pipeline.robot.chunking import (
    Executor,
    PlanGuide,
    check_chunking,
    ensemble,
    soft_mask,
)
from pipeline.robot.session import stack_guides

MODES = get_args(Chunking)
HORIZON = 8


def chunk_of(tick: int, name: float = 0.0, horizon: int = HORIZON) -> np.ndarray:
    """A chunk whose steps say the tick that they are for, and which chunk they are of."""
    return np.stack([tick + np.arange(horizon), np.full(horizon, name)], axis=1)


def play(executor: Executor, steps: int) -> list[float]:
    """The ticks that the next actions are for."""
    return [float(executor.next_action()[0]) for _ in range(steps)]


class TestDue:
    @pytest.mark.parametrize(("chunking", "execute"), [*zip(MODES, (1, 3, HORIZON), strict=True)])
    def test_it_is_before_the_first_chunk_and_every_so_many_steps(
        self, chunking: Chunking, execute: int
    ) -> None:
        executor, observed = Executor(chunking, execute, HORIZON), []
        for tick in range(20):
            if executor.due:
                executor.begin()
                executor.plan(chunk_of(tick))
                observed.append(tick)
            assert not executor.due
            assert executor.next_action()[0] == tick
        assert observed == list(range(0, 20, execute))

    def test_while_a_chunk_is_computed_no_other_is_wanted(self) -> None:
        executor = Executor("none", 2, HORIZON)
        executor.begin()
        assert not executor.due
        executor.plan(chunk_of(0))
        play(executor, 3)
        assert executor.due
        executor.begin()
        play(executor, 5)
        assert not executor.due

    def test_a_late_chunk_is_as_old_as_its_observation(self) -> None:
        executor = Executor("none", 4, HORIZON)
        executor.begin()
        executor.plan(chunk_of(0))
        play(executor, 4)
        executor.begin()
        play(executor, 3)
        executor.plan(chunk_of(4))
        assert not executor.due
        play(executor, 1)
        assert executor.due

    @pytest.mark.parametrize("execute", [0, 9])
    def test_more_steps_than_a_chunk_has_are_refused(self, execute: int) -> None:
        with pytest.raises(ConfigError, match=rf"rollout\.execute: expected 1 to 8.*{execute}"):
            Executor("none", execute, HORIZON)


@pytest.mark.parametrize("chunking", MODES)
class TestSteps:
    def test_steps_are_skipped_that_were_played_meanwhile(self, chunking: Chunking) -> None:
        executor = Executor(chunking, 2, HORIZON)
        executor.begin()
        executor.plan(chunk_of(0))
        assert play(executor, 2) == [0, 1]
        executor.begin()
        assert play(executor, 3) == [2, 3, 4]
        executor.plan(chunk_of(2))
        assert play(executor, 5) == [5, 6, 7, 8, 9]

    def test_a_robot_that_stood_still_skips_nothing(self, chunking: Chunking) -> None:
        """Others drop as many steps as the computation is believed to have taken."""
        executor = Executor(chunking, 1, HORIZON)
        for tick, delay in ((0, 0), (1, 4), (6, 0), (7, 0)):
            executor.begin()
            play(executor, delay)
            executor.plan(chunk_of(tick))
            assert play(executor, 1) == [tick + delay]

    def test_a_chunk_used_up_gives_no_action(self, chunking: Chunking) -> None:
        executor = Executor(chunking, 2, HORIZON)
        with pytest.raises(AssertionError, match="no action at tick 0"):
            executor.next_action()
        executor.begin()
        executor.plan(chunk_of(0))
        executor.begin()
        play(executor, HORIZON)
        with pytest.raises(AssertionError, match="no action at tick 8"):
            executor.next_action()
        executor.plan(chunk_of(0))
        assert executor.due
        with pytest.raises(AssertionError, match="no action at tick 8"):
            executor.next_action()

    def test_a_second_begin_takes_the_place_of_the_first(self, chunking: Chunking) -> None:
        executor = Executor(chunking, 2, HORIZON)
        executor.begin()
        executor.plan(chunk_of(0))
        executor.begin()
        play(executor, 3)
        executor.begin()
        executor.plan(chunk_of(3))
        assert play(executor, 2) == [3, 4]

    def test_a_chunk_without_an_observation_has_no_place(self, chunking: Chunking) -> None:
        executor = Executor(chunking, 2, HORIZON)
        with pytest.raises(AssertionError, match="begin"):
            executor.plan(chunk_of(0))

    def test_reset_forgets_the_episode(self, chunking: Chunking) -> None:
        executor = Executor(chunking, 1, HORIZON)
        for _ in range(3):
            executor.begin()
            executor.plan(chunk_of(100))
            play(executor, 1)
        executor.begin()
        executor.reset()
        assert executor.due
        assert executor.begin() is None
        executor.plan(chunk_of(0))
        assert play(executor, 2) == [0, 1]

    def test_a_chunk_is_copied(self, chunking: Chunking) -> None:
        executor, buffer = Executor(chunking, 2, HORIZON), chunk_of(0)
        executor.begin()
        executor.plan(buffer)
        buffer[:] = -1
        action = executor.next_action()
        action[:] = -1
        assert play(executor, 2) == [1, 2]
        assert action.dtype == np.float32

    @given(st.lists(st.tuples(st.booleans(), st.integers(0, 3)), max_size=30))
    def test_whatever_the_delays_every_step_is_that_of_its_tick(
        self, chunking: Chunking, turns: list[tuple[bool, int]]
    ) -> None:
        executor = Executor(chunking, 1, HORIZON)
        tick = 0
        executor.begin()
        executor.plan(chunk_of(0))
        for again, delay in turns:
            for _ in range(1 + again):
                executor.begin()
            begun = tick
            assert play(executor, delay) == list(range(tick, tick + delay))
            tick += delay
            executor.plan(chunk_of(begun))
            assert play(executor, 1) == [tick]
            tick += 1


class TestTemporal:
    def test_all_chunks_that_reach_a_tick_are_averaged_the_oldest_first(self) -> None:
        """In closed form."""
        executor, horizon = Executor("temporal", 1, 3), 3
        names = [5.0, -1.0, 2.0, 8.0]
        for tick, name in enumerate(names):
            executor.begin()
            executor.plan(chunk_of(tick, name, horizon))
            reach = names[max(0, tick - horizon + 1) : tick + 1]
            weights = [np.exp(0.2 * i) for i in range(len(reach))]
            mean = sum(w * n for w, n in zip(weights, reach, strict=True)) / sum(weights)
            assert executor.next_action().tolist() == pytest.approx([tick, mean])

    def test_other_modes_play_the_newest_alone(self) -> None:
        for chunking in ("none", "rtc"):
            executor = Executor(chunking, 1, HORIZON)
            for tick in range(3):
                executor.begin()
                executor.plan(chunk_of(tick, float(tick)))
                assert executor.next_action().tolist() == [tick, tick]

    def test_the_newest_weighs_most(self) -> None:
        mean = ensemble(np.array([[0.0], [0.0], [1.0]]))
        assert mean[0] > 1 / 3
        assert ensemble(np.array([[7.0]])) == [7.0]


class TestMoving:
    """Channels that say how far to move: what counts is where a chunk leads to."""

    @staticmethod
    def executor(chunking: Chunking = "none", execute: int = 1) -> Executor:
        return Executor(chunking, execute, HORIZON, [True, False])

    @staticmethod
    def deltas(step: float, place: float = 7.0) -> np.ndarray:
        return np.tile(np.array([step, place], np.float32), (HORIZON, 1))

    @given(st.data(), st.sampled_from(["none", "rtc"]), st.integers(1, HORIZON))
    def test_a_chunk_in_time_is_played_as_it_is(
        self, data: st.DataObject, chunking: Chunking, execute: int
    ) -> None:
        executor, steps = self.executor(chunking, execute), st.floats(-3, 3, width=32)
        for _ in range(4):
            chunk = np.array([[data.draw(steps), 7.0] for _ in range(HORIZON)], np.float32)
            executor.begin()
            executor.plan(chunk)
            played = np.stack([executor.next_action() for _ in range(execute)])
            np.testing.assert_allclose(played, chunk[:execute], atol=1e-6)

    def test_a_late_chunk_leads_to_where_it_meant_to(self) -> None:
        """What an older chunk moved meanwhile is not moved again."""
        executor = self.executor()
        executor.begin()
        executor.plan(self.deltas(1.0))
        executor.next_action()
        executor.begin()
        assert [executor.next_action()[0] for _ in range(3)] == [1, 1, 1]
        executor.plan(self.deltas(-2.0, place=9.0))
        # Its fourth step ends 8 below where it was asked for; the robot was sent 3 above that.
        assert executor.next_action().tolist() == [-11, 9]
        assert executor.next_action().tolist() == [-2, 9]

    def test_a_guide_is_what_will_be_played(self) -> None:
        executor = self.executor("rtc")
        executor.begin()
        executor.plan(self.deltas(1.0))
        executor.next_action()
        executor.begin()
        for _ in range(3):
            executor.next_action()
        executor.plan(self.deltas(-2.0, place=9.0))
        guide = executor.begin()
        assert guide is not None
        assert guide.chunk[:2].tolist() == [[-11, 9], [-2, 9]]
        assert executor.next_action().tolist() == [-11, 9]

    def test_ensembles_average_places(self) -> None:
        executor = self.executor("temporal")
        sent, plans = 0.0, []
        for step in (1.0, -1.0, 0.5, 0.0):
            executor.begin()
            executor.plan(self.deltas(step))
            plans.append(sent + step * np.arange(1, HORIZON + 1))
            now = [plan[len(plans) - 1 - begun] for begun, plan in enumerate(plans)]
            place = np.average(now, weights=np.exp(0.2 * np.arange(len(now))))
            action = executor.next_action()
            assert action.tolist() == pytest.approx([place - sent, 7.0])
            sent = place

    def test_plans_that_agree_move_as_each_of_them(self) -> None:
        """Deltas of other ticks do not: averaged, a robot that slows down never arrives."""
        executor, sent = self.executor("temporal"), 0.0
        for tick in range(30):
            places = 1 - 0.5 ** (1 + tick + np.arange(HORIZON))
            chunk = np.diff(places, prepend=sent)[:, None] * [1, 0]
            executor.begin()
            executor.plan(chunk)
            sent += float(executor.next_action()[0])
            assert sent == pytest.approx(places[0])

    def test_reset_forgets_where_the_robot_was_sent(self) -> None:
        executor = self.executor("temporal")
        for _ in range(2):
            executor.reset()
            executor.begin()
            executor.plan(self.deltas(1.0))
            assert executor.next_action().tolist() == [1, 7]


class TestGuide:
    @staticmethod
    def under_way(execute: int = 3, played: int = 3) -> Executor:
        executor = Executor("rtc", execute, HORIZON)
        executor.begin()
        executor.plan(chunk_of(0) + 1)
        play(executor, played)
        return executor

    @pytest.mark.parametrize("played", [0, 3, 7])
    def test_its_first_step_is_that_of_the_observations_tick(self, played: int) -> None:
        executor = self.under_way(played=played)
        guide = executor.begin()
        assert guide is not None
        assert np.array_equal(guide.chunk[0], executor.next_action())
        assert np.array_equal(guide.chunk[: HORIZON - played], chunk_of(played)[: 8 - played] + 1)

    @pytest.mark.parametrize(("played", "execute"), [(0, 3), (3, 5), (5, 3), (7, 1)])
    def test_what_the_plan_does_not_reach_weighs_nothing(self, played: int, execute: int) -> None:
        """Zeros with weight would decode to the mean action."""
        guide = self.under_way(execute, played).begin()
        assert guide is not None
        ends = HORIZON - max(played, execute)
        assert (guide.weight[:ends] > 0).all()
        assert (guide.weight[ends:] == 0).all()
        assert (guide.chunk[guide.weight > 0] > 0).all()

    def test_as_many_steps_are_held_as_any_of_the_last_ten_chunks_took(self) -> None:
        executor, held = self.under_way(execute=1), []
        for delay in (2, 1, *[0] * 11):
            guide = executor.begin()
            assert guide is not None
            held.append(int((guide.weight == 1).sum()))
            play(executor, delay)
            executor.plan(chunk_of(0))
        assert held == [0, *[2] * 10, 1, 0]

    def test_a_warm_up_does_not_poison_the_estimate(self) -> None:
        """The first chunk takes long, while the robot stands still: nothing is to be held for it.

        A clock would count the seconds of the warm-up, and hold ten chunks for them.
        """
        executor = Executor("rtc", 1, HORIZON)
        executor.begin()  # however long until the plan: no step is played
        executor.plan(chunk_of(0) + 1)
        for tick in range(1, 12):
            play(executor, 1)
            guide = executor.begin()
            assert guide is not None and (guide.weight < 1).all()
            executor.plan(chunk_of(tick) + 1)

    @pytest.mark.parametrize("chunking", ["none", "temporal"])
    def test_other_modes_guide_nothing(self, chunking: Chunking) -> None:
        executor = Executor(chunking, 1, HORIZON)
        assert executor.begin() is None
        executor.plan(chunk_of(0))
        assert executor.begin() is None

    def test_there_is_none_before_a_plan_and_at_its_end(self) -> None:
        assert Executor("rtc", 3, HORIZON).begin() is None
        assert self.under_way(played=HORIZON).begin() is None
        assert self.under_way(execute=HORIZON, played=4).begin() is None

    def test_the_plan_stays_as_it_is(self) -> None:
        executor = self.under_way()
        guide = executor.begin()
        assert guide is not None
        guide.chunk[:] = -1
        assert play(executor, 2) == [4, 5]


class TestSoftMask:
    def test_it_is_that_of_the_paper(self) -> None:
        """Eq. 5 written out, H = 10, s = 3, d = 2."""
        c = [5 / 6, 4 / 6, 3 / 6, 2 / 6, 1 / 6]
        falling = [x * (np.e**x - 1) / (np.e - 1) for x in c]
        expected = [1, 1, *falling, 0, 0, 0]
        np.testing.assert_allclose(soft_mask(10, 2, 7), expected, rtol=1e-6)

    def test_it_falls_and_ends(self) -> None:
        for delay, overlap in product(range(HORIZON + 2), range(1, HORIZON + 1)):
            weight = soft_mask(HORIZON, delay, overlap)
            assert (weight.dtype, weight.shape) == (np.float32, (HORIZON,))
            assert (np.diff(weight) <= 0).all()
            assert np.array_equal(weight == 1, np.arange(HORIZON) < min(delay, overlap))
            assert np.array_equal(weight > 0, np.arange(HORIZON) < overlap)


class TestStack:
    def test_robots_without_a_plan_weigh_nothing(self) -> None:
        plan = PlanGuide(np.full((4, 2), 3, np.float32), np.full(4, 0.5, np.float32))
        guide = stack_guides([None, plan, None], torch.device("cpu"))
        assert guide is not None
        assert guide.chunk.shape == (3, 4, 2)
        assert guide.weight.tolist() == [[0] * 4, [0.5] * 4, [0] * 4]
        assert guide.chunk.sum(dim=(1, 2)).tolist() == [0, 24, 0]

    def test_where_no_robot_has_a_plan_there_is_no_guide(self) -> None:
        assert stack_guides([None, None], torch.device("cpu")) is None


class TestSent:
    """What a robot was sent in place of what the executor gave."""

    def test_what_was_cut_off_is_made_up_for(self) -> None:
        executor = Executor("none", 3, 4, (True, True))
        executor.begin()
        executor.plan(np.ones((4, 2), np.float32))
        assert executor.next_action().tolist() == [1, 1]
        executor.sent([0.25, 1])
        assert executor.next_action().tolist() == [1.75, 1]
        executor.sent([1, 1])
        assert executor.next_action().tolist() == [1.75, 1]

    def test_a_newer_chunk_counts_from_where_the_robot_was_really_sent(self) -> None:
        executor = Executor("none", 1, 4, (True, True))
        executor.begin()
        executor.plan(np.ones((4, 2), np.float32))
        executor.next_action()
        executor.sent([0.25, 0.25])
        executor.begin()
        executor.plan(np.ones((4, 2), np.float32))
        assert executor.next_action().tolist() == [1, 1]

    def test_channels_that_say_where_to_be_have_nothing_to_make_up_for(self) -> None:
        executor = Executor("none", 3, 4, (True, False))
        executor.begin()
        executor.plan(np.array([[1, 5], [1, 6], [1, 7], [1, 8]], np.float32))
        executor.next_action()
        executor.sent([0.5, 2])
        assert executor.next_action().tolist() == [1.5, 6]


def test_a_policy_that_draws_nothing_cannot_be_guided() -> None:
    with pytest.raises(ConfigError, match=r"rollout\.chunking: .*found rtc"):
        check_chunking("rtc", stochastic=False)
    check_chunking("rtc", stochastic=True)
    check_chunking("none", stochastic=False)
    check_chunking("temporal", stochastic=False)


def test_playing_chunks_needs_no_torch() -> None:
    code = "import sys, pipeline.robot.chunking; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
