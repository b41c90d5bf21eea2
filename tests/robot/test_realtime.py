"""The loop in real time: what it asks and does, and that whatever goes wrong stops the robot.

Time is simulated, so a busy machine changes nothing: only sleeping moves the clock, and an answer
comes when the policy's latency is over. `TestThreads` has the real clock and the real thread.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import LimitsFile
from pipeline.base.errors import ConfigError
from pipeline.robot.limits import Limits
from pipeline.robot.loop import StopKind
from pipeline.robot.realtime import RunSettings, run_robot
from pipeline.robot.run_report import RunReport

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
    "looks_at": ["features", "sensor", "state"],
    "sensor_window": 16,
    "state_window": 16,
}
CALM = RunSettings("Go there", seconds=0.3, hung_s=5)
Observed = dict[str, Any]


@pytest.fixture(autouse=True)
def simulated_time(simulated_time: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "time", simulated_time)


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

    latency_s = 0.0
    """Simulated, of each answer; it comes in the next tick at the earliest."""

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

    def after(self, latency_s: float) -> "Brain":
        self.latency_s = latency_s
        return self


class Notes:
    """A recorder that keeps what it is told, and fails where it is to: at a tick, or at the end."""

    def __init__(self, fails: OSError | None = None, cannot: Exception | None = None) -> None:
        self.ticks: list[tuple[Mapping[str, Any], Any]] = []
        self.seen = self.answers = 0
        self.reason, self._fails, self._cannot = "", fails, cannot

    def tick(self, observed: Mapping[str, Any], action: Any) -> None:
        if self._fails:
            raise self._fails
        self.ticks.append((observed, action))

    @property
    def actions(self) -> int:
        return sum(action is not None for _, action in self.ticks)

    def frames(self, frames: Mapping[str, Any]) -> None:
        assert set(frames) == {"View1"}
        self.seen += 1

    def answer(self, answer: Mapping[str, Any]) -> None:
        self.answers += 1

    def finish(self, reason: str, timings: Mapping[str, Any]) -> Path:
        self.reason = reason
        assert set(timings) == {"tick_ms", "answer_ms"}
        if self._cannot:
            raise self._cannot
        return Path("recording")


def stopped(
    arm: Arm, kind: StopKind, said: str, brain: Brain | None = None, **changed: Any
) -> RunReport:
    """The report of a run that must end so, before its time is up, with the robot told to stop and
    nothing sent that is no number or leaps."""
    limits, recorder = changed.pop("limits", None), changed.pop("recorder", None)
    settings = replace(CALM, **{"seconds": 20.0} | changed)
    report = run_robot(arm, brain or Brain(), settings, limits, recorder)
    assert (report.kind, said in report.reason) == (kind, True), (report.kind, report.reason)
    assert report.reason in arm.stops
    assert (np.abs(np.array(arm.acts or [0.0])) < 2).all()
    return report


def after(tick: int, do: Callable[[Observed], Any]) -> Callable[[int, Observed], None]:
    """From this tick on."""
    return lambda now, observed: do(observed) if now >= tick else None


def limits(**file: Any) -> Limits:
    return Limits(LimitsFile.model_validate(file), META, 200.0)


def ticks_of(questions: list[Mapping[str, Any]]) -> list[int]:
    """The ticks that a run of 200 Hz asked in."""
    return [round(200 * (float(question["time"][0]) - 1000 - AHEAD_S)) for question in questions]


def test_a_run_asks_acts_and_records_until_its_time_is_up() -> None:
    arm, brain, notes = Arm(), Brain(), Notes()
    report = run_robot(arm, brain, CALM, recorder=notes)
    assert (report.kind, arm.stops) == (StopKind.TIME, ["0.3 s are over"])
    assert (report.ticks, report.left_out, arm.ticks) == (60, 0, 60)
    # Until the first chunk is there nothing is played, so the next is not yet due.
    assert ticks_of(brain.asked) == [0, *range(2, 60)]
    assert (report.answers, len(arm.acts)) == (58, 59)
    # All readings are told once, and frames every third tick.
    states = np.concatenate([asked["state"][:, 0] for asked in brain.asked])
    np.testing.assert_array_equal(states, np.repeat(np.arange(len(states) / 2), 2))
    times = np.concatenate([asked["sensor_time"] for asked in brain.asked])
    assert (np.diff(times) > 0).all()
    assert brain.asked[0]["reset"] is True and not any("reset" in q for q in brain.asked[1:])
    assert {asked["prompt"] for asked in brain.asked} == {"Go there"}
    with_frames = [asked for asked in brain.asked if "images/View1" in asked]
    assert ticks_of(with_frames) == list(range(0, 60, 3))
    # So are they to the recorder.
    assert (len(notes.ticks), notes.actions) == (report.ticks, len(arm.acts))
    assert (notes.seen, notes.answers) == (len(with_frames), report.answers)
    assert notes.reason == report.reason and report.recording == Path("recording")


def test_deadlines_do_not_drift() -> None:
    """Ticks that take most of their time begin where they would have begun without."""
    arm = Arm(lambda tick, observed: time.sleep(0.07))
    report = run_robot(arm, Brain(action_hz=10.0), replace(CALM, seconds=1.6))
    assert report.kind == StopKind.TIME and report.ticks == 16
    np.testing.assert_allclose(arm.began, 1000 + np.arange(16) / 10, atol=1e-9)


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


def test_real_time_chunking_guides_by_what_is_left_of_the_plan() -> None:
    brain = Brain(action_hz=50.0).after(0.03)
    run_robot(Arm(), brain, replace(CALM, chunking="rtc", execute=3, seed=5, seconds=0.6))
    assert brain.asked[0]["reset"] == 5 and "guide/chunk" not in brain.asked[0]
    guided = [asked for asked in brain.asked if "guide/chunk" in asked]
    assert guided and guided[0]["guide/chunk"].shape == (HORIZON, 2)
    assert all(asked["guide/weight"][0] > 0 for asked in guided)


def test_a_new_episode_begins_with_nothing_and_no_answer_of_the_last_one() -> None:
    """The answer that is awaited when tick 20 begins a new episode would move by 5."""

    def answers(n: int, answer: Observed) -> None:
        brain.latency_s = 0.105 if n == 2 else 0.0
        if n == 2:
            answer["actions"][:] = 5.0

    def begin(tick: int, observed: Observed) -> None:
        observed["reset"] = tick == 20
        observed["ended"] = "enough" if tick == 60 else None

    arm, brain = Arm(begin), Brain(answers)
    report = run_robot(arm, brain, replace(CALM, seconds=20))
    assert report.kind == StopKind.ENDED
    resets = [n for n, asked in enumerate(brain.asked) if "reset" in asked]
    assert resets == [0, 2] and "images/View1" in brain.asked[2]
    assert max(max(action) for action in arm.acts) < 1


def test_what_limits_cut_off_is_made_up_for() -> None:
    def enough(tick: int, observed: Observed) -> None:
        observed["ended"] = "enough" if len(arm.acts) >= 6 else None

    arm, chunk = Arm(enough), np.zeros((HORIZON, 2))
    chunk[0, 0] = 1.0
    brain = Brain(lambda n, answer: answer.update(actions=chunk))
    step = limits(step={"most": {"dx": 0.25}, "on_exceed": "clip"})
    report = run_robot(arm, brain, replace(CALM, execute=HORIZON, seconds=20), step)
    # The chunk's first step leads 1 mm ahead; the later ones stay there.
    assert [action[0] for action in arm.acts] == [0.25] * 4 + [0] * 2
    assert report.clipped == 3


def test_a_plan_that_is_used_up_stops_the_robot() -> None:
    def answers(n: int, answer: Observed) -> None:
        brain.latency_s = 0.0 if n <= 2 else 1.0

    arm, brain = Arm(), Brain(answers)
    report = stopped(arm, StopKind.NO_CHUNK, "used up", brain)
    assert len(arm.acts) == HORIZON + 1 and report.answers == 2
    assert "ms at most; half of a chunk is 100 ms" in report.reason


def fail_at(at: int, error: BaseException) -> Callable[..., None]:
    """What raises this at the call of that number."""

    def fail(number: int, *_: Any) -> None:
        if number == at:
            raise error

    return fail


def moved(seconds: float, *names: str) -> Callable[[Observed], None]:
    """Times that lie so much further."""
    return lambda observed: observed.update({name: observed[name] + seconds for name in names})


def frame_of_age(age_s: float) -> Arm:
    old = lambda frames: frames.update(View1=(time.monotonic() + AHEAD_S - age_s, np.zeros(1)))  # noqa: E731
    return Arm(sees=after(8, old))


ALL_TIMES = ("time", "state_time", "sensor_time")
STOPS: dict[str, Callable[[], RunReport]] = {
    "a first chunk that never comes": lambda: stopped(
        Arm(), StopKind.NO_CHUNK, "first chunk", Brain().after(0.3), first_answer_s=0.1
    ),
    "an action that is no number": lambda: stopped(
        Arm(), StopKind.NOT_A_NUMBER, "the policy's action",
        Brain(lambda n, answer: answer["actions"][-1].fill(np.nan if n == 5 else 0.1)),
    ),
    "a jump beyond limits": lambda: stopped(
        Arm(), StopKind.LIMIT, "step of translation",
        Brain(lambda n, answer: answer.update(actions=np.full((HORIZON, 2), 9.0 * (n == 5)))),
        limits=limits(step={"most": {"translation": 2.0}}),
    ),
    "features that stay old": lambda: stopped(
        Arm(), StopKind.OLD_FEATURES, "newest features",
        Brain(lambda n, answer: answer.update(feature_age_s=0.01 * n)), old_features_s=0.2,
    ),
    "features of no age": lambda: stopped(
        Arm(), StopKind.OLD_FEATURES, "nan s old",
        Brain(lambda n, answer: answer.update(feature_age_s=np.nan)),
    ),
    "a dead camera": lambda: stopped(
        Arm(sees=after(8, dict[str, Any].clear)), StopKind.CAMERA, "View1: the robot gives no frame"
    ),
    "an old frame": lambda: stopped(frame_of_age(1.0), StopKind.CAMERA, "1.00 s old"),
    "a frame of the future": lambda: stopped(frame_of_age(-1.0), StopKind.CAMERA, "-1.00 s old"),
    "a chunk of another shape": lambda: stopped(
        Arm(), StopKind.POLICY, "(40, 2), found (40, 3)",
        Brain(lambda n, answer: answer.update(actions=np.zeros((HORIZON, 3)))),
    ),
    "leaving the workspace": lambda: stopped(
        Arm(), StopKind.WORKSPACE, "x measured at 13",
        limits=limits(workspace={"box": {"x": [-1, 12]}}),
    ),
    "a state of the future": lambda: stopped(
        Arm(after(9, moved(1, "state_time"))), StopKind.CLOCK, "of the future, by 0.900 s"
    ),
    "readings that go back in time": lambda: stopped(
        Arm(after(9, lambda seen: seen.update(state_time=seen["state_time"][::-1]))),
        StopKind.CLOCK, "older than the one before",
    ),
    "a clock that leaps": lambda: stopped(
        Arm(after(15, moved(1, *ALL_TIMES))), StopKind.CLOCK, "clock is +1.000 s from"
    ),
    "slow ticks": lambda: stopped(
        Arm(moves=lambda tick: time.sleep(0.05) if tick >= 5 else None), StopKind.MISSED, "'act'"
    ),
    "a policy that fails": lambda: stopped(
        Arm(), StopKind.POLICY, "ValueError: no such head",
        Brain(fail_at(3, ValueError("no such head"))),
    ),
    "a lost connection": lambda: stopped(
        Arm(), StopKind.CONNECTION, "gone", Brain(fail_at(3, ConnectionResetError("gone")))
    ),
    "a recorder that fails": lambda: stopped(
        Arm(), StopKind.RECORDER, "disk full", recorder=Notes(OSError("disk full"))
    ),
}  # fmt: skip
"""What ends a run by itself, before its time is up."""


@pytest.mark.parametrize("stop", STOPS.values(), ids=STOPS)
def test_whatever_goes_wrong_stops_the_robot(stop: Callable[[], RunReport]) -> None:
    stop()


def without_sensor(observed: Observed) -> None:
    observed["sensor_time"] = observed["sensor"] = []


def test_a_stream_that_stalls_stops_the_robot_unless_nobody_watches_or_looks_at_it() -> None:
    stopped(Arm(after(9, without_sensor)), StopKind.STALLED, "sensor: no new", stalled_s=0.15)
    unwatched = replace(CALM, stalled_s=0.15, watch=())
    assert run_robot(Arm(after(9, without_sensor)), Brain(), unwatched).kind == StopKind.TIME
    brain = Brain(looks_at=["features", "state"])
    watched = replace(CALM, stalled_s=0.15)
    assert run_robot(Arm(after(9, without_sensor)), brain, watched).kind == StopKind.TIME
    assert all("sensor" not in asked and "state" in asked for asked in brain.asked)


def test_a_stream_that_limits_are_of_is_watched_whatever_the_policy_looks_at() -> None:
    brain, arm = Brain(looks_at=["features", "state"]), Arm(after(9, without_sensor))
    force = limits(force={"most": {"force": 2.5}})
    stopped(arm, StopKind.STALLED, "sensor", brain, limits=force, stalled_s=0.15)
    assert all("sensor" not in asked for asked in brain.asked)


def test_one_slow_tick_is_counted() -> None:
    arm = Arm(moves=lambda tick: time.sleep(0.0525) if tick == 10 else None)
    report = run_robot(arm, Brain(), replace(CALM, missed_in_a_row=20))
    assert (report.missed_ticks, report.left_out, report.ticks) == (1, 10, 50)
    assert len(arm.acts) == 49, "no two actions of one tick, and none of those left out"


def test_an_exception_in_the_robots_code_stops_it_and_is_told() -> None:
    arm = Arm(sees=fail_at(7, RuntimeError("bus error")))
    said = "the robot's code failed (frames): RuntimeError: bus error"
    assert "raise error" in stopped(arm, StopKind.ROBOT, said).traceback


ENDINGS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


@pytest.mark.parametrize("number", [signal.SIGTERM, None])
def test_a_signal_stops_the_robot_and_none_breaks_off_the_stop(number: int | None) -> None:
    """None: the robot ends the run, and signals come only while it is stopped."""

    class Interrupted(Arm):
        def stop(self, reason: str) -> None:
            for each in ENDINGS:
                signal.raise_signal(each)
            super().stop(reason)

    def end(tick: int, observed: Observed) -> None:
        if tick == 7 and number is None:
            observed["ended"] = "enough"
        elif tick == 7:
            signal.raise_signal(number)

    # If it fails, then not by ending the tests.
    kept = {each: signal.signal(each, signal.default_int_handler) for each in ENDINGS}
    try:
        arm = Interrupted(end)
        if number is None:
            stopped(arm, StopKind.ENDED, "enough")
        else:
            stopped(arm, StopKind.BY_HAND, "stopped by hand (SIGTERM)")
        assert len(arm.stops) == 1
        assert all(signal.getsignal(each) is signal.default_int_handler for each in ENDINGS)
    finally:
        for each, handler in kept.items():
            signal.signal(each, handler)


def test_a_signal_that_the_process_passes_over_does_not_end_the_run() -> None:
    kept = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        arm = Arm(moves=lambda tick: signal.raise_signal(signal.SIGTERM))
        assert run_robot(arm, Brain(), replace(CALM, seconds=0.05)).kind == StopKind.TIME
    finally:
        signal.signal(signal.SIGTERM, kept)


class Stubborn(Arm):
    """Its first `stop` fails."""

    def stop(self, reason: str) -> None:
        super().stop(reason)
        if len(self.stops) == 1:
            raise ConnectionError("bus off")


def test_a_stop_that_fails_is_tried_again_and_hides_nothing() -> None:
    arm, notes = Stubborn(fail_at(6, RuntimeError("bus error"))), Notes()
    report = stopped(arm, StopKind.ROBOT, "failed (observe): RuntimeError", recorder=notes)
    assert len(arm.stops) == 2 and notes.reason == report.reason
    assert report.recording == Path("recording")
    assert report.traceback.count("robot.stop failed: Traceback") == 1
    assert "policy" not in {thread.name for thread in threading.enumerate()}


def test_the_robot_is_stopped_whatever_ends_the_process() -> None:
    arm = Arm(moves=fail_at(3, SystemExit(3)))
    with pytest.raises(SystemExit):
        run_robot(arm, Brain(), CALM)
    assert len(arm.stops) == 1


def test_a_recording_that_cannot_be_finished_hides_no_reason() -> None:
    short = replace(CALM, seconds=0.05)
    report = run_robot(Arm(), Brain(), short, recorder=Notes(cannot=ValueError("no codec")))
    assert (report.kind, report.recording) == (StopKind.TIME, None)
    assert report.traceback == "no recording: ValueError: no codec"


@pytest.mark.parametrize(
    ("name", "value", "kind", "said"),
    [
        ("sensor", np.array([[-3.0]], np.float32), StopKind.FORCE, "force measured at -3"),
        ("state", np.full((2, 2), np.nan, np.float32), StopKind.NOT_A_NUMBER, "state"),
    ],
)
def test_the_tick_that_stops_the_robot_is_recorded(name, value, kind, said) -> None:
    notes, arm = Notes(), Arm(after(9, lambda seen: seen.update({name: value})))
    stopped(arm, kind, said, recorder=notes, limits=limits(force={"most": {"force": 2.5}}))
    assert len(notes.ticks) == arm.ticks == 10
    observed, action = notes.ticks[-1]
    assert observed[name] is value and action is None


def test_an_action_that_the_robot_failed_at_is_recorded() -> None:
    arm, notes = Arm(moves=fail_at(6, RuntimeError("bus error"))), Notes()
    stopped(arm, StopKind.ROBOT, "failed (act)", recorder=notes)
    assert len(notes.ticks) == arm.ticks and notes.actions == len(arm.acts) + 1


@pytest.mark.parametrize(
    ("changed", "said"), [({"hz": 100.0}, r"hz=100, .* found 200"), ({"execute": 41}, "execute")]
)
def test_what_does_not_fit_is_refused_before_anything_is_asked(changed, said):
    arm = Arm()
    with pytest.raises(ConfigError, match=said):
        run_robot(arm, Brain(), replace(CALM, **changed), limits(step={"most": {"dx": 1}}))
    assert not arm.ticks and not arm.stops


class TestThreads:
    """The real clock, the policy's thread and the watchdog; what happens waits for events."""

    @pytest.fixture(autouse=True)
    def simulated_time(self) -> None:
        """Overrides that of the module: nothing is simulated."""

    CALM = replace(
        CALM, seconds=60, stalled_s=60, old_frame_s=60, old_features_s=60, hung_s=60,
        clock_drift_s=60, missed_in_a_row=10**6,
    )  # fmt: skip
    """For a machine that may suspend the test for a minute."""

    def test_the_policy_is_never_waited_for(self) -> None:
        """Twenty ticks go by while it answers the first question; none acts before."""

        def observe(tick: int, observed: Observed) -> None:
            if tick == 20:
                assert not arm.acts
                go.set()
                assert answered.wait(60)
            observed["ended"] = "enough" if len(arm.acts) == 3 else None

        def answers(n: int, answer: Observed) -> None:
            assert go.wait(60)
            answered.set()

        go, answered = threading.Event(), threading.Event()
        arm = Arm(observe)
        report = run_robot(arm, Brain(answers), self.CALM)
        assert (report.kind, len(arm.acts)) == (StopKind.ENDED, 3), report.reason
        assert arm.ticks > 20

    def test_a_loop_that_hangs_is_stopped_by_the_watchdog(self) -> None:
        """`act` blocks until another thread has stopped the robot, again where that raises."""

        class Blocking(Stubborn):
            def stop(self, reason: str) -> None:
                super().stop(reason)
                told.set()

        told = threading.Event()
        arm = Blocking(moves=lambda tick: told.wait(60))
        settings = replace(self.CALM, hung_s=0.1)
        report = run_robot(arm, Brain(), settings)
        assert (report.kind, report.reason) == (StopKind.HUNG, "no tick has ended for 0.1 s")
        assert len(arm.stops) == 3
        assert report.traceback.count("robot.stop failed: Traceback") == 1
