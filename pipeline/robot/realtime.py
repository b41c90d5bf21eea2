"""The control loop in real time: a tick at each deadline, and a policy that is never waited for.

`_Run.go` is the pacing: deadline k is start + k / hz on the monotonic clock, so nothing drifts, and
ticks whose deadline has passed are left out. `_Run.tick` is one tick, a list of steps. A robot
stops safely where a step raises `SafeStop`, with a `StopKind`:

    check         clock, readings that are not numbers or stall (`readings`), workspace, force
    take_answer   no first chunk in time, a policy that failed (`PolicyThread`) or answers wrongly
    ask           a camera that is missing or late
    act           a plan that is used up, old features, motion limits (`limits`), robot.act
    miss          too many ticks left out
    watchdog      no tick ends any more (`process`)

Whatever else raises stops it too, and the part of the tick says whose error it is. Times of
readings and frames stay on the robot's clock. Numpy only.
"""

import math
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Chunking
from pipeline.base.errors import ConfigError
from pipeline.robot.limits import Limits
from pipeline.robot.loop import ControlLoop, Executor, SafeStop, StopKind
from pipeline.robot.loop_process import (
    PolicyThread,
    Watchdog,
    ended_by_hand,
    stop_firmly,
    undisturbed,
)
from pipeline.robot.readings import PendingReadings, RobotClock
from pipeline.robot.run_report import (
    ANSWER_PARTS,
    RunReport,
    TickPart,
    TickTimer,
    allowed_ms,
)

if TYPE_CHECKING:  # It writes images and parquet, which the loop does not need.
    from pipeline.robot.recorder import RunRecorder

Frames = Mapping[str, tuple[float, NDArray[np.uint8]]]

_BLAMED: Mapping[TickPart, StopKind] = {
    **dict.fromkeys(("observe", "frames", "act"), StopKind.ROBOT),
    "record": StopKind.RECORDER,
}


class Robot(Protocol):
    """What moves, and what it measures."""

    def observe(self) -> Mapping[str, Any]:
        """`state`, `state_time`, `sensor`, `sensor_time`: the readings since the last call; `time`
        (1,), its clock now, s. `reset` true where a new episode has begun since; `ended`, a text
        that says why there is no more to do."""
        ...

    def frames(self) -> Frames:
        """The newest frame of each camera: when it was taken, s, and RGB."""
        ...

    def act(self, action: NDArray[np.float64]) -> object:
        """Carry out one action, in the units of the policy's metadata."""

    def stop(self, reason: str) -> object:
        """Stand still from now on; another thread may call this, and twice."""


class PolicySession(Protocol):
    """A policy that remembers one robot: `Session` in this process, `PolicyClient` over a wire."""

    @property
    def metadata(self) -> Mapping[str, Any]:
        """The streams, rates and shapes that it takes and gives."""
        ...

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """Its answer; raises `ConnectionError` where nobody answers any more."""
        ...


@dataclass(frozen=True)
class RunSettings:
    """How a robot is run, and when it stops."""

    instruction: str
    hz: float | None = None
    """Ticks a second; the policy's `action_hz` where None."""
    execute: int = 1
    chunking: Chunking = "temporal"
    seconds: float | None = None
    """How long; None: until something ends it."""
    seed: int | None = None
    """Seeds the samples that the policy draws."""
    clock_drift_s: float = 0.1
    """How far the robot's clock may leave its offset, and a reading lie in the future."""
    first_answer_s: float = 60.0
    """How long the first chunk may take. The client's own timeout (`PolicyClient(timeout_s=…)`,
    10 s) ends the wait earlier, so raise that one too."""
    old_features_s: float = 2.0
    """Greatest age of the newest frame that the features have seen."""
    old_frame_s: float = 0.5
    stalled_s: float = 0.5
    """How long a stream may bring no new reading."""
    watch: tuple[str, ...] | None = None
    """Streams that must bring readings; None: all that the policy or the limits look at."""
    missed_in_a_row: int = 5
    """Ticks left out, with none in time between them, at which the robot stops."""
    hung_s: float = 0.5
    """How long a tick may take, at least two and a half ticks, before the watchdog stops it."""


def run_robot(
    robot: Robot,
    policy: PolicySession,
    settings: RunSettings,
    limits: Limits | None = None,
    recorder: "RunRecorder | None" = None,
) -> RunReport:
    """Run a robot until something ends the run, then call `robot.stop`, again where it raises.

    On the main thread Ctrl-C, SIGTERM and SIGHUP (a lost ssh) end the run as well, and the process
    goes on; those that come while the robot is stopped are ignored. On another thread no signal
    ends the run. Nobody stops the robot where the process is killed (SIGKILL, no memory, no power):
    its own controller must, when no action comes.

    Raises `ConfigError` before the first observation where settings do not fit the policy or the
    limits.
    """
    with undisturbed(), ended_by_hand() as signals:
        run = _Run(robot, policy, settings, limits, recorder)
        report = run.report
        try:
            try:
                run.go()
            finally:
                signals.append("")  # From here on a signal interrupts nothing.
        except SafeStop as stop:
            report.kind, report.reason = stop.kind, str(stop)
        except KeyboardInterrupt as hand:
            report.kind = StopKind.BY_HAND
            report.reason = f"stopped by hand ({str(hand) or 'SIGINT'})"
        except Exception as error:
            report.kind, report.reason = run.blame(error)
            report.traceback = traceback.format_exc()
        finally:
            report.traceback += stop_firmly(robot.stop, report.reason) + run.close()
    if recorder is not None:
        try:
            timings = {"tick_ms": report.tick_timings, "answer_ms": report.answer_timings}
            documents = {name: own.document() for name, own in timings.items()}
            report.recording = recorder.finish(report.reason, documents)
        except Exception as error:  # The report still says why the robot stands still.
            report.traceback += f"no recording: {type(error).__name__}: {error}"
    return report


class _Run:
    """One run: the loop, and what it knows between its ticks."""

    def __init__(
        self,
        robot: Robot,
        policy: PolicySession,
        settings: RunSettings,
        limits: Limits | None,
        recorder: "RunRecorder | None",
    ) -> None:
        self.robot, self.settings, self.limits, self.recorder = robot, settings, limits, recorder
        meta = policy.metadata
        self.hz = float(settings.hz or meta["action_hz"])
        if limits is not None and abs(limits.hz - self.hz) > 1e-3 * self.hz:
            raise ConfigError(
                f"limits: expected hz={self.hz:g}, the actions that the loop sends a second, found "
                f"{limits.hz:g}. Make the limits with hz={self.hz:g}."
            )
        self.chunk_shape = (meta["horizon"], meta["action_dim"])
        self.views = tuple(meta["streams"]["views"]) if meta["uses_features"] else ()
        moving = tuple(meta["moving"])
        executor = Executor(
            settings.chunking, settings.execute, meta["horizon"], moving, "drive.settings"
        )
        reuse = max(1, round(meta["vlm_reuse_count"] * self.hz / meta["action_hz"]))
        self.loop = ControlLoop(executor, reuse, meta["uses_features"])
        self.policy = PolicyThread(policy.infer)
        self.looks_at = set(meta["looks_at"]) - {"features"}
        self.pending = {
            name: PendingReadings(
                max(4 * meta[f"{name}_window"], 64), len(meta["streams"][name]["names"])
            )
            for name in sorted(self.looks_at | (limits.streams if limits else set()))
        }
        self.watched = tuple(self.pending) if settings.watch is None else settings.watch
        self.clock = RobotClock(settings.clock_drift_s)
        self.report = RunReport()
        self.timer, self.missed_in_a_row = TickTimer(), 0
        self.unrecorded: tuple[Mapping[str, Any], NDArray[np.float64] | None] | None = None
        self.begin_episode()
        self.watchdog = Watchdog(robot.stop, max(settings.hung_s, 2.5 / self.hz))

    def go(self) -> None:
        """Run tick after tick, each at its deadline, until a `SafeStop`."""
        period, start, tick = 1 / self.hz, time.monotonic(), 0
        while True:
            deadline = start + tick * period
            time.sleep(max(0.0, deadline - time.monotonic()))
            self.timer.begin(deadline)
            if self.settings.seconds is not None and tick >= self.settings.seconds * self.hz:
                raise SafeStop(StopKind.TIME, f"{self.settings.seconds:g} s are over")
            self.tick()
            ended = self.timer.end()
            self.report.tick_timings.note(self.timer.row_ms())
            self.report.ticks += 1
            following = tick + 1
            if ended > deadline + period:
                following = max(following, math.ceil((ended - start) * self.hz))
                self.miss(following - tick - 1)
            else:
                self.missed_in_a_row = 0
            tick = following

    def tick(self) -> None:
        """Observe, check, take an answer, ask, act, record."""
        self.timer.mark("observe")
        observed = self.robot.observe()
        self.timer.mark("check")
        if observed.get("reset"):
            self.begin_episode()
        self.check(observed)
        if ended := observed.get("ended"):
            raise SafeStop(StopKind.ENDED, str(ended))
        self.loop.begin_tick()
        self.timer.mark("plan")
        self.take_answer()
        if self.loop.chunk_due and not self.policy.busy:
            self.ask()
        self.timer.mark("plan")
        self.act(observed)
        self.record()
        self.watchdog.beat()
        self.watchdog.check()

    def begin_episode(self) -> None:
        """Forget the last episode, and the answer that is still to come for it."""
        self.loop.reset()
        self.policy.forget()
        self.reset: bool | int = True if self.settings.seed is None else self.settings.seed
        self.begun_s = time.monotonic()
        self.asked_s = self.frames_s = self.features_s = -math.inf
        for pending in self.pending.values():
            pending.forget()
        if self.limits is not None:
            self.limits.reset()

    def check(self, observed: Mapping[str, Any]) -> None:
        """Take the readings, or stop."""
        self.now_s = float(observed["time"][0])
        readings = {
            name: (observed[name], observed[f"{name}_time"])
            for name in self.pending
            if len(observed.get(f"{name}_time", ()))
        }
        for name, (values, times) in readings.items():
            expected = (len(times), self.pending[name].channels)
            if values.shape != expected:
                why = f"{name}: expected {expected}, found {values.shape}"
                raise SafeStop(StopKind.ROBOT, why)
        self.unrecorded = observed, None  # Only now: readings of another shape spoil a recording.
        self.clock.check(self.now_s)
        latest_s = self.now_s + self.settings.clock_drift_s
        for name, pending in self.pending.items():
            if name in readings:
                pending.append(name, *readings[name], latest_s)
            elif pending.newest_s is None:
                pending.newest_s = self.now_s
            if name in self.watched:
                silent_s = self.clock.now_s() - (pending.newest_s or 0.0)
                if silent_s > self.settings.stalled_s:
                    raise SafeStop(StopKind.STALLED, f"{name}: no new reading for {silent_s:.2f} s")
        if self.limits is not None:
            self.limits.check(observed)

    def take_answer(self) -> None:
        """Plan the chunk of an answer, where one has come."""
        if (answer := self.policy.take()) is None:
            first_s, waited_s = self.settings.first_answer_s, time.monotonic() - self.begun_s
            if not self.loop.executor.planned and waited_s > first_s:
                raise SafeStop(StopKind.NO_CHUNK, f"no first chunk within {first_s:g} s")
            return
        timing: Mapping[str, float] = answer.get("server_timing") or {}
        parts = (timing.get(part, math.nan) for part in ANSWER_PARTS[1:])
        self.report.answer_timings.note((1000 * self.policy.took_s, *parts))
        if self.recorder is not None:
            self.timer.mark("record")
            self.recorder.answer(answer)
            self.timer.mark("plan")
        if answer.get("feature_age_s") is not None:
            self.features_s = self.asked_s - float(answer["feature_age_s"])
            if self.features_s >= self.frames_s - 1e-3:
                self.loop.pass_ended()
        chunk = np.asarray(answer["actions"], np.float32)
        if chunk.shape != self.chunk_shape:
            why = f"expected a chunk {self.chunk_shape}, found {chunk.shape}"
            raise SafeStop(StopKind.POLICY, why)
        self.loop.plan(chunk)

    def ask(self) -> None:
        """Ask with the readings since the last question, and with frames where they are due."""
        question: dict[str, Any] = {"prompt": self.settings.instruction}
        if self.now_s - self.frames_s > self.settings.old_features_s / 2:
            self.loop.pass_ended()  # The server may have skipped a pass, and does not say so.
        if self.loop.frames_due:
            question |= self.newest_frames()
            self.loop.pass_began()
        self.timer.mark("ask")
        # A frame may have come since the robot was observed.
        self.asked_s = max(self.asked_s, self.now_s, self.frames_s)
        for name in sorted(self.looks_at):
            if len(self.pending[name]):
                question[name], question[f"{name}_time"] = self.pending[name].hand_over()
                self.asked_s = max(self.asked_s, float(question[f"{name}_time"][-1]))
        question["time"] = np.array([self.asked_s])
        if self.reset is not False:
            question["reset"], self.reset = self.reset, False
        if (guide := self.loop.ask()) is not None:
            question |= {"guide/chunk": guide.chunk, "guide/weight": guide.weight}
        self.policy.ask(question)

    def newest_frames(self) -> dict[str, Any]:
        """The newest frames of the policy's views, and when they were taken."""
        self.timer.mark("frames")
        frames, fields = self.robot.frames(), dict[str, Any]()
        for view in self.views:
            if view not in frames:
                raise SafeStop(StopKind.CAMERA, f"{view}: the robot gives no frame")
            taken_s, frame = frames[view]
            age_s = self.now_s - taken_s
            if not -self.settings.clock_drift_s <= age_s <= self.settings.old_frame_s:
                raise SafeStop(StopKind.CAMERA, f"{view}: the newest frame is {age_s:.2f} s old")
            fields |= {f"images/{view}": frame, f"images_time/{view}": np.array([taken_s])}
        if self.recorder is not None:
            self.timer.mark("record")
            self.recorder.frames({view: frames[view] for view in self.views})
        self.frames_s = max(frames[view][0] for view in self.views)
        return fields

    def _answer_times(self) -> str:
        """How long answers took, beside how long they may take."""
        took = self.report.answer_timings.document().get(ANSWER_PARTS[0])
        if took is None:
            return ""
        half_ms = allowed_ms(self.loop.executor.horizon, self.hz)
        return (
            f": answers took {took['p50']:.0f} ms (median), {took['max']:.0f} ms at most; half of "
            f"a chunk is {half_ms:.0f} ms"
        )

    def act(self, observed: Mapping[str, Any]) -> None:
        """Send this tick's action within the limits; nothing before the first chunk."""
        try:
            action = self.loop.action()
        except SafeStop as stop:
            raise SafeStop(stop.kind, f"{stop}{self._answer_times()}") from None
        if action is not None:
            age_s = self.now_s - self.features_s if self.views else 0.0
            if not age_s <= self.settings.old_features_s:
                raise SafeStop(StopKind.OLD_FEATURES, f"the newest features are {age_s:.2f} s old")
            if self.limits is not None:
                allowed = self.limits.allow(action)
                if allowed is not action:
                    self.loop.executor.sent(allowed)
                action = allowed
        self.watchdog.check()
        if action is not None:
            self.timer.mark("act")
            self.unrecorded = observed, action
            self.robot.act(action)

    def record(self) -> None:
        """Give the recorder this tick, once: at its end, or where it has stopped the robot."""
        unrecorded, self.unrecorded = self.unrecorded, None
        if self.recorder is not None and unrecorded is not None:
            self.timer.mark("record")
            self.recorder.tick(*unrecorded)

    def miss(self, left_out: int) -> None:
        """Count a late tick; stop where too many are left out while the robot moves."""
        seconds = self.timer.seconds
        part = max(seconds, key=seconds.__getitem__)
        self.report.missed_ticks += 1
        self.report.left_out += left_out
        self.missed_in_a_row += left_out
        if self.limits is not None:
            self.limits.stood_still()
        if self.missed_in_a_row >= self.settings.missed_in_a_row and self.loop.executor.planned:
            why = f"{self.missed_in_a_row} ticks in a row, most of the last in {part!r}"
            raise SafeStop(StopKind.MISSED, why)

    def blame(self, error: Exception) -> tuple[StopKind, str]:
        """Whose error it is, by the part of the tick, and the reason that names it."""
        if self.timer.part == "check":
            self.unrecorded = None  # Readings that cannot be checked would spoil the recording.
        kind = _BLAMED.get(self.timer.part, StopKind.LOOP)
        return kind, f"{kind.value} ({self.timer.part}): {type(error).__name__}: {error}"

    def close(self) -> str:
        """Record the tick that stopped the robot, end the threads, complete the report.

        Returns the tracebacks of what failed meanwhile.
        """
        failed = ""
        try:
            self.record()
        except Exception:
            failed = f"the last tick is not recorded: {traceback.format_exc()}"
        self.watchdog.close()
        self.policy.close()
        self.report.clipped = self.limits.clipped if self.limits else 0
        return self.watchdog.failed + failed
