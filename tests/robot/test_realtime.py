"""The loop in real time: what it asks and does, and that whatever goes wrong stops the robot."""

import gc
import json
import os
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import LimitsFile
from pipeline.base.errors import ConfigError, RecordingError
from pipeline.robot.limits import Limits
from pipeline.robot.loop import StopKind
from pipeline.robot.realtime import RunReport, RunSettings, run_robot

HORIZON, AHEAD_S = 40, 1000.0
META: dict[str, Any] = {
    "streams": {
        "action": {"names": ["dx", "dy"], "units": ["mm", "mm"], "kind": "delta"},
        "state": {"names": ["x", "y"], "units": ["mm", "mm"]},
        "sensor": {"names": ["force"], "units": ["N"]},
        "views": ["View1"],
    },
    "action_hz": 200.0,
    "vlm_reuse_count": 3,
    "horizon": HORIZON,
    "action_dim": 2,
    "moving": [True, True],
    "uses_features": True,
    "sensor_window": 16,
    "state_window": 16,
}
CALM = RunSettings(
    "Go there", seconds=0.3, stalled_s=5, old_frame_s=5, old_features_s=5, hung_s=5,
    clock_drift_s=2, missed_in_a_row=10**6,
)  # fmt: skip
"""Of a machine that does something else now and then."""
Observed = dict[str, Any]


class Arm:
    """A healthy robot, but for what `spoil`, `moves` and `sees` do to what it says and does."""

    def __init__(
        self,
        spoil: Callable[[int, Observed], Any] = lambda tick, observed: None,
        moves: Callable[[int], Any] = lambda tick: None,
        sees: Callable[[int, dict[str, Any]], Any] = lambda tick, frames: None,
    ) -> None:
        self._spoil, self._moves, self._sees = spoil, moves, sees
        self.ticks, self.acts, self.stops = 0, list[tuple[float, ...]](), list[str]()
        self.began: list[float] = []

    def now(self) -> float:
        return time.monotonic() + AHEAD_S

    def observe(self) -> Observed:
        self.began.append(time.monotonic())
        now, tick = self.now(), self.ticks
        observed = {
            "time": np.array([now]),
            "state": np.full((2, 2), tick, np.float32),
            "state_time": np.array([now - 1e-4, now]),
            "sensor": np.zeros((1, 1), np.float32),
            "sensor_time": np.array([now]),
        }
        self._spoil(tick, observed)
        self.ticks += 1
        return observed

    def frames(self) -> dict[str, Any]:
        frames = {"View1": (self.now() - 1e-3, np.zeros((4, 4, 3), np.uint8))}
        self._sees(self.ticks, frames)
        return frames

    def act(self, action: np.ndarray) -> None:
        self._moves(len(self.acts))
        self.acts.append(tuple(action.tolist()))

    def stop(self, reason: str) -> None:
        self.stops.append(reason)


class Brain:
    """A policy that answers with the same chunk, but for what `answers` does; keeps all it saw."""

    def __init__(
        self, answers: Callable[[int, Observed], Any] = lambda n, answer: None, **metadata: Any
    ) -> None:
        self.metadata = META | metadata
        self._answers, self.asked, self._seen_s = answers, list[Mapping[str, Any]](), 0.0

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        self.asked.append(observation)
        self._seen_s = float(observation.get("images_time/View1", [self._seen_s])[0])
        answer: Observed = {
            "actions": np.full((HORIZON, 2), 0.1, np.float32),
            "feature_age_s": float(observation["time"][0]) - self._seen_s,
            "server_timing": {"infer_ms": 1.0},
        }
        self._answers(len(self.asked), answer)
        return answer


def stopped(
    arm: Arm, kind: StopKind, said: str, brain: Brain | None = None, **changed: Any
) -> RunReport:
    """The report of a run that must end so, before its time is up, with the robot told to stop."""
    limits, recorder = changed.pop("limits", None), changed.pop("recorder", None)
    settings = replace(CALM, **{"seconds": 20.0} | changed)
    report = run_robot(arm, brain or Brain(), settings, limits, recorder)
    assert (report.kind, said in report.reason) == (kind, True), (report.kind, report.reason)
    assert report.reason in arm.stops
    assert json.dumps(report.document())
    return report


def after(tick: int, do: Callable[[Observed], Any]) -> Callable[[int, Observed], None]:
    """From this tick on."""
    return lambda now, observed: do(observed) if now >= tick else None


def put(name: str, value: Any) -> Callable[[Observed], None]:
    return lambda observed: observed.__setitem__(name, value)


def limits(**file: Any) -> Limits:
    return Limits(LimitsFile.model_validate(file), META, 200.0)


def test_a_run_ends_when_its_time_is_up_and_each_tick_was_run_or_is_told_to_be_left_out() -> None:
    arm, brain = Arm(), Brain()
    report = run_robot(arm, brain, CALM)
    assert (report.kind, arm.stops) == (StopKind.TIME, ["0.3 s are over"])
    assert report.ticks + report.left_out >= 60
    assert report.ticks == arm.ticks and report.answers > 0
    ticks = report.actions[:, 0]
    assert len(ticks) == len(arm.acts) and (np.diff(ticks) >= 1).all()
    assert abs(report.clock_offset_s - AHEAD_S) < 0.01
    assert set(report.tick_timings.document()) >= {"late", "observe", "act", "tick"}


def test_deadlines_do_not_drift() -> None:
    """Ticks that take most of their time begin where they would have begun without."""
    arm = Arm(moves=lambda tick: time.sleep(0.07))
    run_robot(arm, Brain(action_hz=10.0), replace(CALM, seconds=1.6))
    begun = (np.array(arm.began) - arm.began[0]) * 10
    assert len(begun) > 10
    assert np.median(np.abs(begun - np.round(begun))) < 0.15


def test_the_policy_is_told_all_readings_once_and_frames_every_third_tick() -> None:
    brain = Brain()
    arm = Arm()
    report = run_robot(arm, brain, CALM)
    states = np.concatenate([asked["state"][:, 0] for asked in brain.asked])
    np.testing.assert_array_equal(states, np.repeat(np.arange(len(states) / 2), 2))
    assert report.dropped_readings == 0
    times = np.concatenate([asked["sensor_time"] for asked in brain.asked])
    assert (np.diff(times) > 0).all()
    assert brain.asked[0]["reset"] is True and not any("reset" in q for q in brain.asked[1:])
    assert {asked["prompt"] for asked in brain.asked} == {"Go there"}
    with_frames = [n for n, asked in enumerate(brain.asked) if "images/View1" in asked]
    assert with_frames[0] == 0 and len(with_frames) <= report.ticks / 3 + 1
    assert len(with_frames) > len(brain.asked) / 6


def test_a_frame_that_came_after_the_readings_is_not_of_the_future() -> None:
    """As `ObservationReader` takes it: nothing is later than the question, and none goes back."""

    def now(tick: int, frames: dict[str, Any]) -> None:
        frames["View1"] = (arm.now() + 0.004, frames["View1"][1])

    arm, brain = Arm(sees=now), Brain()
    assert run_robot(arm, brain, CALM).kind == StopKind.TIME
    asked = np.array([question["time"][0] for question in brain.asked])
    assert (np.diff(asked) >= 0).all()
    for question in brain.asked:
        for name in ("state_time", "sensor_time", "images_time/View1"):
            assert (question.get(name, [-np.inf])[-1]) <= question["time"][0]


def test_the_policy_is_never_waited_for() -> None:
    arm = Arm()
    brain = Brain(lambda n, answer: time.sleep(0.1), action_hz=50.0)
    report = run_robot(arm, brain, replace(CALM, seconds=1.0))
    assert report.answers < 11 and report.ticks > 40
    assert report.answer_timings.document()["answer"]["p50"] > 99


def test_real_time_chunking_guides_by_what_is_left_of_the_plan() -> None:
    brain = Brain(lambda n, answer: time.sleep(0.03), action_hz=50.0)
    run_robot(Arm(), brain, replace(CALM, chunking="rtc", execute=3, seed=5, seconds=0.6))
    assert brain.asked[0]["reset"] == 5 and "guide/chunk" not in brain.asked[0]
    guided = [asked for asked in brain.asked if "guide/chunk" in asked]
    assert guided and guided[0]["guide/chunk"].shape == (HORIZON, 2)
    assert all(asked["guide/weight"][0] > 0 for asked in guided)


def test_a_new_episode_begins_with_nothing_and_no_answer_of_the_last_one() -> None:
    """The answer that is under way when tick 20 begins a new episode would move by 5."""

    def answers(n: int, answer: Observed) -> None:
        if arm.ticks <= 20:
            time.sleep(0.015)
            if arm.ticks > 20:
                answer["actions"][:] = 5.0

    arm = Arm(spoil=lambda tick, observed: observed.update(reset=tick == 20))
    brain = Brain(answers)
    report = run_robot(arm, brain, CALM)
    assert report.kind == StopKind.TIME
    resets = [n for n, asked in enumerate(brain.asked) if "reset" in asked]
    assert len(resets) == 2 and resets[0] == 0 and "images/View1" in brain.asked[resets[1]]
    assert max(max(action) for action in arm.acts) < 1


def test_what_limits_cut_off_is_made_up_for() -> None:
    def answers(n: int, answer: Observed) -> None:
        answer["actions"][:] = 0
        answer["actions"][:, 0] = [1.0, *[0.0] * (HORIZON - 1)]

    arm = Arm()
    brain = Brain(answers)
    step = limits(step={"most": {"dx": 0.25}, "on_exceed": "clip"})
    report = run_robot(arm, brain, replace(CALM, execute=HORIZON, seconds=0.1), step)
    # The chunk's first step leads 1 mm ahead; the later ones stay there.
    assert [action[0] for action in arm.acts[:6]] in ([0.25] * 4 + [0] * 2, [0.25] * 6)
    assert report.clipped >= 3


def test_a_plan_that_is_used_up_stops_the_robot() -> None:
    late = threading.Event()
    brain = Brain(lambda n, answer: late.wait(1) if n > 1 else None)
    arm = Arm()
    stopped(arm, StopKind.NO_CHUNK, "used up", brain)
    assert len(arm.acts) <= HORIZON


def test_a_first_chunk_that_never_comes_stops_the_robot() -> None:
    arm = Arm()
    brain = Brain(lambda n, answer: time.sleep(0.3))
    stopped(arm, StopKind.NO_CHUNK, "first chunk", brain, first_answer_s=0.1)
    assert not arm.acts


def test_features_that_stay_old_stop_the_robot() -> None:
    brain = Brain(lambda n, answer: answer.update(feature_age_s=0.01 * n))
    stopped(Arm(), StopKind.OLD_FEATURES, "newest features", brain, old_features_s=0.2)


def test_a_dead_camera_stops_the_robot() -> None:
    arm = Arm(sees=after(8, dict[str, Any].clear))
    stopped(arm, StopKind.CAMERA, "View1: the robot gives no frame")


@pytest.mark.parametrize(("age_s", "said"), [(1.0, "1.00 s old"), (-1.0, "-1.00 s old")])
def test_a_frame_that_is_old_or_of_the_future_stops_the_robot(age_s: float, said: str) -> None:
    def old(frames: dict[str, Any]) -> None:
        frames["View1"] = (arm.now() - age_s, frames["View1"][1])

    arm = Arm(sees=after(8, old))
    stopped(arm, StopKind.CAMERA, said, old_frame_s=0.5, clock_drift_s=0.5)


@pytest.mark.parametrize("stream", ["state", "sensor"])
def test_a_stream_that_stalls_stops_the_robot_unless_nobody_watches(stream: str) -> None:
    def stall(observed: Observed) -> None:
        del observed[stream], observed[f"{stream}_time"]

    stopped(Arm(after(9, stall)), StopKind.STALLED, f"{stream}: no new reading", stalled_s=0.15)
    unwatched = replace(CALM, stalled_s=0.15, watch=())
    assert run_robot(Arm(after(9, stall)), Brain(), unwatched).kind == StopKind.TIME


def test_readings_that_keep_their_time_have_stalled() -> None:
    def stuck(observed: Observed) -> None:
        observed["sensor_time"] = kept.setdefault("time", observed["sensor_time"])

    kept: dict[str, Any] = {}
    stopped(Arm(after(9, stuck)), StopKind.STALLED, "sensor", stalled_s=0.15)


@pytest.mark.parametrize("stream", ["state", "sensor"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_reading_that_is_no_number_stops_the_robot(stream: str, bad: float) -> None:
    def spoil(observed: Observed) -> None:
        observed[stream][-1, -1] = bad

    stopped(Arm(after(9, spoil)), StopKind.NOT_A_NUMBER, stream)


def test_an_action_that_is_no_number_stops_the_robot() -> None:
    def spoil(n: int, answer: Observed) -> None:
        answer["actions"][-1, 1] = np.nan if n == 5 else 0.1

    arm = Arm()
    stopped(arm, StopKind.NOT_A_NUMBER, "the policy's action", Brain(spoil))
    assert np.isfinite(arm.acts).all()


def test_a_chunk_of_another_shape_stops_the_robot() -> None:
    brain = Brain(lambda n, answer: answer.update(actions=np.zeros((HORIZON, 3))))
    stopped(Arm(), StopKind.POLICY, "(40, 2), found (40, 3)", brain)


def test_a_jump_beyond_limits_stops_the_robot_before_it_is_sent() -> None:
    def jump(n: int, answer: Observed) -> None:
        answer["actions"][:] = 9.0 if n == 5 else 0.1

    arm = Arm()
    step = limits(step={"most": {"translation": 2.0}})
    stopped(arm, StopKind.LIMIT, "step of translation", Brain(jump), limits=step)
    assert max(map(max, arm.acts)) < 2


def test_too_much_force_stops_the_robot() -> None:
    press = after(9, put("sensor", np.array([[-3.0]], np.float32)))
    stopped(Arm(press), StopKind.FORCE, "force measured at -3",
            limits=limits(force={"most": {"force": 2.5}}))  # fmt: skip


def test_leaving_the_workspace_stops_the_robot() -> None:
    outside = limits(workspace={"box": {"x": [-1, 12]}})
    stopped(Arm(), StopKind.WORKSPACE, "x measured at 13", limits=outside)


@pytest.mark.parametrize("stream", ["state", "sensor"])
def test_a_reading_of_the_future_stops_the_robot(stream: str) -> None:
    def ahead(observed: Observed) -> None:
        observed[f"{stream}_time"] = observed[f"{stream}_time"] + 1

    stopped(Arm(after(9, ahead)), StopKind.CLOCK, "of the future", clock_drift_s=0.5)


def test_readings_that_go_back_in_time_stop_the_robot() -> None:
    def back(observed: Observed) -> None:
        observed["state_time"] = observed["state_time"][::-1]

    stopped(Arm(after(9, back)), StopKind.CLOCK, "older than the one before")


@pytest.mark.parametrize("jump_s", [1.0, -1.0])
def test_a_clock_that_jumps_stops_the_robot(jump_s: float) -> None:
    def jump(observed: Observed) -> None:
        for name in ("time", "state_time", "sensor_time"):
            observed[name] = observed[name] + jump_s

    arm = Arm(after(15, jump))
    stopped(arm, StopKind.CLOCK, "the robot's clock is", clock_drift_s=0.5)


def test_a_declared_offset_that_is_wrong_stops_the_robot() -> None:
    stopped(Arm(), StopKind.CLOCK, "the robot's clock is", clock_offset_s=0.0, clock_drift_s=0.5)
    right = replace(CALM, clock_offset_s=AHEAD_S)
    assert run_robot(Arm(), Brain(), right).kind == StopKind.TIME


def test_one_slow_tick_is_counted_and_told_with_the_part_that_took_the_time() -> None:
    arm = Arm(moves=lambda tick: time.sleep(0.0525) if tick == 10 else None)
    report = run_robot(arm, Brain(), CALM)
    slow = [missed for missed in report.missed if missed.part == "act"]
    assert len(slow) >= 1 and max(missed.late_ms for missed in slow) > 45
    assert max(missed.left_out for missed in slow) >= 10
    assert report.left_out == sum(missed.left_out for missed in report.missed)
    assert report.missed_ticks == len(report.missed)
    # No two actions of one tick, and none of those left out.
    ticks = report.actions[:, 0]
    gaps = dict(zip(ticks.tolist(), np.diff(ticks).tolist(), strict=False))
    worst = max(slow, key=lambda missed: missed.late_ms)
    assert gaps[worst.tick] == worst.left_out + 1


def test_too_many_slow_ticks_stop_the_robot() -> None:
    arm = Arm(moves=lambda tick: time.sleep(0.012) if tick >= 5 else None)
    stopped(arm, StopKind.MISSED, "'act'", missed_in_a_row=8)


def test_a_policy_that_fails_stops_the_robot() -> None:
    def fail(n: int, answer: Observed) -> None:
        if n == 3:
            raise ValueError("no such head")

    stopped(Arm(), StopKind.POLICY, "ValueError: no such head", Brain(fail))


def test_a_lost_connection_stops_the_robot() -> None:
    def fail(n: int, answer: Observed) -> None:
        if n == 3:
            raise ConnectionResetError("gone")

    stopped(Arm(), StopKind.CONNECTION, "gone", Brain(fail))


@pytest.mark.parametrize("where", ["observe", "act", "frames"])
def test_an_exception_in_the_robots_code_stops_it_and_is_told(where: str) -> None:
    def fail(tick: int, *_: Any) -> None:
        if tick >= 6:
            raise RuntimeError("bus error")

    arm = Arm(**{{"observe": "spoil", "act": "moves", "frames": "sees"}[where]: fail})
    report = stopped(arm, StopKind.ROBOT, f"the robot's {where} failed: RuntimeError: bus error")
    assert 'raise RuntimeError("bus error")' in report.traceback


def test_a_recorder_that_fails_stops_the_robot() -> None:
    class Full(Notes):
        def tick(self, observed: Mapping[str, Any], action: Any) -> None:
            raise OSError("disk full")

    stopped(Arm(), StopKind.RECORDER, "disk full", recorder=Full())


def test_ctrl_c_stops_the_robot() -> None:
    def interrupt(tick: int) -> None:
        if tick == 7:
            raise KeyboardInterrupt

    stopped(Arm(moves=interrupt), StopKind.BY_HAND, "Ctrl-C")


def test_the_robot_is_stopped_whatever_ends_the_process() -> None:
    def leave(tick: int) -> None:
        sys.exit(3)

    arm = Arm(moves=leave)
    with pytest.raises(SystemExit):
        run_robot(arm, Brain(), CALM)
    assert len(arm.stops) == 1


def test_a_loop_that_hangs_is_stopped_by_the_watchdog() -> None:
    """`act` blocks until another thread has told the robot to stop."""
    told = threading.Event()

    class Blocking(Arm):
        def stop(self, reason: str) -> None:
            super().stop(reason)
            told.set()

    arm = Blocking(moves=lambda tick: told.wait(10) if tick == 7 else None)
    stopped(arm, StopKind.HUNG, "no tick has ended for 0.1 s", hung_s=0.1)
    assert len(arm.stops) == 2 and len(arm.acts) == 8


def test_a_robot_that_has_no_more_to_do_ends_the_run() -> None:
    arm = Arm(after(9, put("ended", "inserted")))
    stopped(arm, StopKind.ENDED, "inserted")


class Notes:
    """A recorder that counts."""

    def __init__(self) -> None:
        self.told: dict[str, int] = {"tick": 0, "action": 0, "frames": 0, "answer": 0}
        self.reason = ""

    def tick(self, observed: Mapping[str, Any], action: Any) -> None:
        self.told["tick"] += 1
        self.told["action"] += action is not None

    def frames(self, frames: Mapping[str, Any]) -> None:
        assert set(frames) == {"View1"}
        self.told["frames"] += 1

    def answer(self, answer: Mapping[str, Any]) -> None:
        self.told["answer"] += 1

    def finish(self, reason: str, timings: Mapping[str, Any]) -> Path:
        self.reason = reason
        assert set(timings) == {"tick_ms", "answer_ms"}
        return Path("recording")


def test_all_that_happens_is_told_to_the_recorder() -> None:
    arm, brain, notes = Arm(), Brain(), Notes()
    report = run_robot(arm, brain, CALM, recorder=notes)
    asked = sum("images/View1" in question for question in brain.asked)
    assert notes.told == {
        "tick": report.ticks, "action": len(arm.acts), "frames": asked, "answer": report.answers
    }  # fmt: skip
    assert notes.reason == report.reason and report.recording == Path("recording")


def test_a_recording_that_cannot_be_finished_hides_no_reason() -> None:
    class Empty(Notes):
        def finish(self, reason: str, timings: Mapping[str, Any]) -> Path:
            raise RecordingError("no action was sent")

    report = run_robot(Arm(), Brain(), replace(CALM, seconds=0.05), recorder=Empty())
    assert (report.kind, report.recording) == (StopKind.TIME, None)
    assert report.traceback == "no recording: no action was sent"


def test_settings_that_do_not_fit_the_policy_are_refused_before_anything_is_asked() -> None:
    arm = Arm()
    with pytest.raises(ConfigError, match="execute"):
        run_robot(arm, Brain(), replace(CALM, execute=HORIZON + 1))
    assert not arm.ticks and not arm.stops


def test_the_process_is_afterwards_as_it_was() -> None:
    def look(tick: int) -> None:
        within.append((sys.getswitchinterval(), gc.isenabled()))

    before, within = (sys.getswitchinterval(), gc.isenabled()), list[Any]()
    run_robot(Arm(moves=look), Brain(), replace(CALM, seconds=0.05))
    assert before == (sys.getswitchinterval(), gc.isenabled())
    assert set(within) == {(5e-4, False)}


def test_the_loop_goes_before_other_threads_where_the_machine_grants_it() -> None:
    def look(tick: int) -> None:
        seen.add(priority())

    def priority() -> tuple[int, int]:
        return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority

    seen: set[tuple[int, int]] = set()
    first = replace(CALM, seconds=0.05, fifo_priority=2)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        with pytest.raises(ConfigError, match="fifo_priority: this machine does not grant"):
            run_robot(Arm(), Brain(), first)
        return
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    arm = Arm(moves=look)
    brain = Brain(lambda n, answer: asked.add(priority()))
    asked: set[tuple[int, int]] = set()
    run_robot(arm, brain, first)
    assert seen == {(os.SCHED_FIFO, 2)} and asked == {(os.SCHED_FIFO, 1)}
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    with pytest.raises(ConfigError, match="does not grant priority 1000"):
        run_robot(arm, brain, replace(first, fifo_priority=1000))


def test_a_thousand_ticks_more_need_no_more_memory() -> None:
    sizes: dict[int, int] = {}

    class Weighed(Brain):
        """Forgets what it saw, and answers for long, that none is late."""

        def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
            self.asked.clear()
            answer = dict(super().infer(observation))
            return answer | {"actions": np.zeros((self.metadata["horizon"], 2), np.float32)}

    def weigh(tick: int, observed: Observed) -> None:
        arm.acts.clear()
        arm.began.clear()
        if tick in (500, 1500):
            sizes[tick] = tracemalloc.get_traced_memory()[0]
            observed["ended"] = "weighed" if tick == 1500 else None

    arm = Arm(weigh)
    tracemalloc.start()
    try:
        settings = replace(CALM, hz=1000.0, seconds=60, kept_ticks=100, execute=100)
        report = run_robot(arm, Weighed(horizon=200), settings, limits(step={"most": {"dx": 1}}))
    finally:
        tracemalloc.stop()
    assert report.reason == "weighed"
    assert sizes[1500] - sizes[500] < 20_000


def test_running_a_robot_needs_no_torch() -> None:
    code = "import sys, pipeline.robot.realtime; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
