"""The control loop in real time: a tick at each deadline, a policy that is never waited for.

Deadline k is start + k / hz on the monotonic clock, so nothing drifts. Times of readings and frames
stay on the robot's clock; its offset to ours is declared or measured, and watched. Whatever goes
wrong ends in `Robot.stop` with a `StopKind` and a reason. Numpy only.
"""

import gc
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Chunking
from pipeline.base.errors import ConfigError, ServerBusy
from pipeline.robot.beside import (
    Asker,
    PendingReadings,
    RobotClock,
    Watchdog,
    go_first,
    stop_firmly,
)
from pipeline.robot.chunking import Executor
from pipeline.robot.limits import Limits
from pipeline.robot.loop import ControlLoop, SafeStop, StopKind
from pipeline.robot.timings import Ring, Timings

if TYPE_CHECKING:  # it writes images and parquet, for which the loop has no need
    from pipeline.robot.recorder import RunRecorder

Frames = Mapping[str, tuple[float, NDArray[np.uint8]]]

TICK_PARTS = ("late", "observe", "check", "plan", "frames", "ask", "act", "record")
"""late: from the deadline to the tick's begin; the others in the order of a tick."""
LATE, OBSERVE, CHECK, PLAN, FRAMES, ASK, ACT, RECORD = range(len(TICK_PARTS))
ANSWER_PARTS = ("answer", "infer_ms", "vlm_ms", "head_ms", "wait_ms")
"""answer: from the question to its answer; the others as the answer's `server_timing` says."""
_BLAMED = dict.fromkeys((OBSERVE, FRAMES, ACT), StopKind.ROBOT) | {RECORD: StopKind.RECORDER}
_BY_HAND = ("SIGINT", "SIGTERM", "SIGHUP")
_SWITCH_S = 5e-4
"""How long another thread of this process may keep Python to itself while the loop waits for it."""


class Robot(Protocol):
    """What moves, and what it measures."""

    def observe(self) -> Mapping[str, Any]:
        """`state`, `state_time`, `sensor`, `sensor_time`: the readings since the last call; `time`
        (1,), its clock now, s. `reset` true where a new episode has begun since; `ended`, a text,
        where there is no more to do, and why."""
        ...

    def frames(self) -> Frames:
        """The newest frame of each camera: when it was taken, s, and RGB."""
        ...

    def act(self, action: NDArray[np.float64]) -> object:
        """Carry out one action, in the units of the policy's metadata."""

    def stop(self, reason: str) -> object:
        """Stand still, now and until told otherwise; another thread may call it, and twice."""


class Decides(Protocol):
    """A policy with its memory, in this process or behind a wire."""

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What it takes and gives."""
        ...

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """Its answer; raises `ConnectionError` where there is nobody to answer any more."""
        ...


@dataclass(frozen=True)
class RunSettings:
    """How a robot is run, and what is still good."""

    instruction: str
    hz: float | None = None
    """Ticks a second; the policy's `action_hz` where None."""
    execute: int = 1
    chunking: Chunking = "none"
    seconds: float | None = None
    """How long; None: until something ends it."""
    seed: int | None = None
    """Of what the policy draws."""
    clock_offset_s: float | None = None
    """The robot's clock less `time.monotonic()`; None: the quickest of the first observations tells
    it."""
    clock_drift_s: float = 0.1
    """How far the robot's clock may leave its offset, and a reading lie in the future."""
    first_answer_s: float = 60.0
    """How long the first chunk may take. It is waited for no longer than the client's own timeout
    (`PolicyClient(timeout_s=…)`, 10 s), so that one must be longer."""
    old_features_s: float = 2.0
    """From the newest frame that the features have seen."""
    old_frame_s: float = 0.5
    stalled_s: float = 0.5
    """How long a stream may bring no new reading."""
    watch: tuple[str, ...] | None = None
    """Streams that must bring readings; None: all that the policy looks at or limits are of."""
    missed_in_a_row: int = 5
    """Ticks left out without one in time between them, from which the robot stops."""
    hung_s: float = 0.5
    """How long a tick may take, at least two and a half of them, before a watchdog stops it."""
    fifo_priority: int = 0
    """2 to 99: the loop's thread goes before whatever has less (SCHED_FIFO of Linux), and the
    policy's thread has one less; needs the right to (`ulimit -r`, or root). 0: as they are. Begin
    the whole process under `chrt -f 1`: any thread that holds Python while another process has its
    core keeps the loop waiting."""
    kept_ticks: int = 65536
    """Of how many of the newest ticks timings and actions are kept."""


@dataclass(frozen=True)
class MissedTick:
    """A tick that ended after its deadline."""

    tick: int
    late_ms: float
    """After the deadline of the next tick."""
    part: str
    """Which took the most time."""
    left_out: int
    """Ticks after it that were not run."""


@dataclass
class RunReport:
    """How a run went and why it ended."""

    hz: float
    tick_timings: Timings
    answer_timings: Timings
    missed: deque[MissedTick]
    """The newest `kept_ticks` at most; `missed_ticks` counts all."""
    kind: StopKind = StopKind.LOOP
    reason: str = "the process ends"
    ticks: int = 0
    """That were run."""
    left_out: int = 0
    """Ticks that were not run, for one before them took too long."""
    missed_ticks: int = 0
    answers: int = 0
    busy: int = 0
    """Questions that the policy's server was too busy to answer; it took their readings."""
    dropped_readings: int = 0
    """Older than all that a policy's window holds, in the time between two questions."""
    clipped: int = 0
    """Ticks in which limits let less through than was wanted."""
    clock_offset_s: float = math.nan
    actions: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(tick, 2 + action): the tick's number, the robot's time, and what was sent, of the newest."""
    recording: Path | None = None
    traceback: str = ""
    """Of what raised, also in stopping and in recording; empty where all went well."""


def run_robot(
    robot: Robot,
    policy: Decides,
    settings: RunSettings,
    limits: Limits | None = None,
    recorder: "RunRecorder | None" = None,
) -> RunReport:
    """Run a robot until something ends it; `robot.stop` has then been called, and once more where
    it raised.

    On the main thread Ctrl-C, SIGTERM and SIGHUP (a lost ssh) end the run as well, and the process
    goes on; those that come while the robot is stopped are passed over. On another thread nothing
    does this for a signal. Nobody stops the robot where the process is killed (SIGKILL, no memory,
    no power): its own controller must, when no action comes.

    Raises `ConfigError` before the first observation where settings do not fit the policy, the
    limits or the machine.
    """
    with _undisturbed(settings.fifo_priority), _ended_by_hand() as heard:
        run = _Run(robot, policy, settings, limits, recorder)
        report = run.report
        try:
            try:
                run.go()
            finally:
                heard.append(0)  # from here on none breaks anything off
        except SafeStop as stop:
            report.kind, report.reason = stop.kind, str(stop)
            if stop.kind is StopKind.ROBOT:
                run.untold = None  # Readings of another shape would spoil the recording.
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
            timings = {
                "tick_ms": report.tick_timings.document(),
                "answer_ms": report.answer_timings.document(),
            }
            report.recording = recorder.finish(report.reason, timings)
        except Exception as error:  # The report still says why the robot stands still.
            report.traceback += f"no recording: {type(error).__name__}: {error}"
    return report


class _Run:
    """One run: what is known between its ticks, in buffers that stay."""

    def __init__(
        self,
        robot: Robot,
        policy: Decides,
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
        executor = Executor(
            settings.chunking, settings.execute, meta["horizon"], tuple(meta["moving"])
        )
        reuse = max(1, round(meta["vlm_reuse_count"] * self.hz / meta["action_hz"]))
        self.loop = ControlLoop(executor, reuse, meta["uses_features"])
        self.asker = Asker(policy.infer, settings.fifo_priority - 1)
        self.watchdog = Watchdog(robot.stop, max(settings.hung_s, 2.5 / self.hz))
        self.looks_at = set(meta["looks_at"]) - {"features"}
        self.pending = {
            name: PendingReadings(
                max(4 * meta[f"{name}_window"], 64), len(meta["streams"][name]["names"])
            )
            for name in sorted(self.looks_at | (limits.streams if limits else set()))
        }
        self.watched = tuple(self.pending) if settings.watch is None else settings.watch
        self.clock = RobotClock(settings.clock_offset_s, settings.clock_drift_s)
        kept = settings.kept_ticks
        ticks, answers = Timings((*TICK_PARTS, "tick"), kept), Timings(ANSWER_PARTS, kept)
        self.report = RunReport(self.hz, ticks, answers, deque(maxlen=kept))
        self.actions = Ring(kept, 2 + meta["action_dim"])
        self.row, self.answer_row = np.zeros(len(TICK_PARTS) + 1), np.zeros(len(ANSWER_PARTS))
        self.doing, self.since, self.in_a_row = LATE, 0.0, 0
        self.untold: tuple[Mapping[str, Any], NDArray[np.float64] | None] | None = None
        self.new_episode()

    def go(self) -> None:
        """Tick after tick, until a `SafeStop`."""
        period, start, tick = 1 / self.hz, time.monotonic(), 0
        self.watchdog.start()
        while True:
            deadline = start + tick * period
            time.sleep(max(0.0, deadline - time.monotonic()))
            self.row[:] = math.nan
            self.doing, self.since = LATE, deadline
            if self.settings.seconds is not None and tick >= self.settings.seconds * self.hz:
                raise SafeStop(StopKind.TIME, f"{self.settings.seconds:g} s are over")
            self.tick(tick)
            self.mark(LATE)
            ended = self.since
            self.row[-1] = np.nansum(self.row[1:-1])
            self.report.tick_timings.note(1000 * self.row)
            self.report.ticks += 1
            following = tick + 1
            if ended > deadline + period:
                following = max(following, math.ceil((ended - start) * self.hz))
                self.note_missed(tick, ended - deadline - period, following - tick - 1)
            else:
                self.in_a_row = 0
            tick = following

    def tick(self, tick: int) -> None:
        """Observe, take an answer, ask, act; what has been done so far stays done if one raises."""
        self.mark(OBSERVE)
        observed = self.robot.observe()
        self.mark(CHECK)
        if observed.get("reset"):
            self.new_episode()
        self.check(observed)
        if ended := observed.get("ended"):
            raise SafeStop(StopKind.ENDED, str(ended))
        self.loop.begin_tick()
        self.mark(PLAN)
        self.take_answer()
        if self.loop.chunk_due and not self.asker.busy:
            self.ask()
        self.mark(PLAN)
        action = self.decide()
        self.watchdog.check()
        if action is not None:
            self.mark(ACT)
            self.untold = observed, action
            self.robot.act(action)
            self.actions.note((tick, self.now_s, *action))
        self.record()
        self.watchdog.beat()
        self.watchdog.check()

    def mark(self, part: int) -> None:
        """What follows is this part: the one before it ends here."""
        now = time.monotonic()
        before = self.row[self.doing]
        self.row[self.doing] = now - self.since + (0 if math.isnan(before) else before)
        self.doing, self.since = part, now

    def record(self) -> None:
        """Tell the recorder of this tick, once: at its end, or where it has stopped the robot."""
        told, self.untold = self.untold, None
        if self.recorder is not None and told is not None:
            self.mark(RECORD)
            self.recorder.tick(*told)

    def new_episode(self) -> None:
        """Forget all of the last one; an answer that is still to come is of the last one, too."""
        self.loop.reset()
        self.reset: bool | int = True if self.settings.seed is None else self.settings.seed
        self.begun_s = time.monotonic()
        self.asked_s = self.frames_s = self.features_s = -math.inf
        self.asker.stale = self.asker.busy
        for pending in self.pending.values():
            pending.forget()
        if self.limits is not None:
            self.limits.reset()

    def check(self, observed: Mapping[str, Any]) -> None:
        """Take the readings. Raises `SafeStop` for what is no longer good of them."""
        self.now_s = float(observed["time"][0])
        self.untold = observed, None
        self.clock.check(self.now_s)
        latest = self.now_s + self.settings.clock_drift_s
        for name, pending in self.pending.items():
            if len(observed.get(f"{name}_time", ())):
                pending.take_in(name, observed[name], observed[f"{name}_time"], latest)
            elif pending.newest_s is None:
                pending.newest_s = self.now_s
            if name in self.watched:
                silent_s = self.clock.now_s() - (pending.newest_s or 0.0)
                if silent_s > self.settings.stalled_s:
                    raise SafeStop(StopKind.STALLED, f"{name}: no new reading for {silent_s:.2f} s")
        if self.limits is not None:
            self.limits.check(observed)

    def take_answer(self) -> None:
        """Plan what was answered, where an answer has come."""
        try:
            answer = self.asker.take()
        except ServerBusy:
            answer = None
            self.report.busy += 1
            if not self.asker.stale:
                self.loop.refused()
            self.asker.stale = False
        first_s = self.settings.first_answer_s
        if answer is None:
            if not self.loop.executor.planned and time.monotonic() - self.begun_s > first_s:
                raise SafeStop(StopKind.NO_CHUNK, f"no first chunk within {first_s:g} s")
            return
        self.note_answer(answer)
        if self.asker.stale:
            self.asker.stale = False
            return
        if answer.get("feature_age_s") is not None:
            self.features_s = self.asked_s - float(answer["feature_age_s"])
            if self.features_s >= self.frames_s - 1e-3:
                self.loop.pass_ended()
        chunk = np.asarray(answer["actions"], np.float32)
        if chunk.shape != self.chunk_shape:
            said = f"expected a chunk {self.chunk_shape}, found {chunk.shape}"
            raise SafeStop(StopKind.POLICY, said)
        self.loop.plan(chunk)

    def note_answer(self, answer: Mapping[str, Any]) -> None:
        """Its timings, and for the recording all of it."""
        told: Mapping[str, Any] = answer.get("server_timing") or {}
        self.answer_row[0] = 1000 * self.asker.took_s
        for column, part in enumerate(ANSWER_PARTS[1:], 1):
            self.answer_row[column] = told.get(part, math.nan)
        self.report.answer_timings.note(self.answer_row)
        self.report.answers += 1
        if self.recorder is not None:
            self.mark(RECORD)
            self.recorder.answer(answer)
            self.mark(PLAN)

    def ask(self) -> None:
        """Ask with the readings since the last question, and frames where they are due."""
        question: dict[str, Any] = {"prompt": self.settings.instruction}
        if self.now_s - self.frames_s > self.settings.old_features_s / 2:
            self.loop.pass_ended()  # Nothing says so, but a pass may have been passed over.
        if self.loop.frames_due:
            question |= self.look()
        self.mark(ASK)
        # A frame may have come since the robot was observed.
        self.asked_s = max(self.asked_s, self.now_s, self.frames_s)
        for name, pending in self.pending.items():
            if pending.pending and name in self.looks_at:
                question[name], question[f"{name}_time"] = pending.hand_over()
                self.asked_s = max(self.asked_s, float(question[f"{name}_time"][-1]))
        question["time"] = np.array([self.asked_s])
        if self.reset is not False:
            question["reset"], self.reset = self.reset, False
        if (guide := self.loop.ask()) is not None:
            question |= {"guide/chunk": guide.chunk, "guide/weight": guide.weight}
        self.asker.ask(question)

    def look(self) -> dict[str, Any]:
        """The newest frames of the views that the policy knows."""
        self.mark(FRAMES)
        frames, question = self.robot.frames(), dict[str, Any]()
        for view in self.views:
            if view not in frames:
                raise SafeStop(StopKind.CAMERA, f"{view}: the robot gives no frame")
            taken_s, frame = frames[view]
            age_s = self.now_s - taken_s
            if not -self.settings.clock_drift_s <= age_s <= self.settings.old_frame_s:
                raise SafeStop(StopKind.CAMERA, f"{view}: the newest frame is {age_s:.2f} s old")
            question |= {f"images/{view}": frame, f"images_time/{view}": np.array([taken_s])}
        if self.recorder is not None:
            self.mark(RECORD)
            self.recorder.frames({view: frames[view] for view in self.views})
        self.frames_s = max(frames[view][0] for view in self.views)
        self.loop.pass_began()
        return question

    def decide(self) -> NDArray[np.float64] | None:
        """What to do in this tick; None, stand still, until the first chunk is there."""
        action = self.loop.action()
        if action is None:
            return None
        age_s = self.now_s - self.features_s if self.views else 0.0
        if not age_s <= self.settings.old_features_s:
            raise SafeStop(StopKind.OLD_FEATURES, f"the newest features are {age_s:.2f} s old")
        if self.limits is None:
            return action
        allowed = self.limits.allow(action)
        if allowed is not action:
            self.loop.executor.sent(allowed)
        return allowed

    def note_missed(self, tick: int, late_s: float, left_out: int) -> None:
        """Raises `SafeStop` where too many are left out in a row of a robot that moves."""
        part = int(np.nanargmax(self.row[:-1]))
        self.report.missed.append(MissedTick(tick, 1000 * late_s, TICK_PARTS[part], left_out))
        self.report.missed_ticks += 1
        self.report.left_out += left_out
        self.in_a_row += left_out
        if self.limits is not None:
            self.limits.stood_still()
        if self.in_a_row >= self.settings.missed_in_a_row and self.loop.executor.planned:
            said = f"{self.in_a_row} ticks in a row, most of the last in {TICK_PARTS[part]!r}"
            raise SafeStop(StopKind.MISSED, said)

    def blame(self, error: Exception) -> tuple[StopKind, str]:
        """Whose error it is, by what was being done."""
        if self.doing == CHECK:
            self.untold = None  # What cannot be checked cannot be recorded, either.
        kind = _BLAMED.get(self.doing, StopKind.LOOP)
        part = TICK_PARTS[self.doing]
        return kind, f"{kind.value} ({part}): {type(error).__name__}: {error}"

    def close(self) -> str:
        """Record the tick that stopped the robot, end the threads, complete the report; the
        traceback of what failed.

        The policy may finish an answer that nobody waits for.
        """
        failed = ""
        try:
            self.record()
        except Exception:
            failed = f"the last tick is not recorded: {traceback.format_exc()}"
        self.watchdog.close()
        self.asker.close()
        self.report.dropped_readings = sum(self.pending[name].dropped for name in self.looks_at)
        self.report.clipped = self.limits.clipped if self.limits else 0
        self.report.clock_offset_s = self.clock.offset_s
        self.report.actions = self.actions.rows()
        return self.watchdog.failed + failed


@contextmanager
def _undisturbed(fifo_priority: int) -> Generator[None]:
    """This thread goes first, and no garbage is collected: the loop makes none that needs it."""
    switch_s, collects = sys.getswitchinterval(), gc.isenabled()
    if fifo_priority not in (0, *range(2, 100)):
        raise ConfigError(f"fifo_priority: expected 0, or 2 to 99, found {fifo_priority}")
    scheduled: tuple[Any, ...] = ()
    if fifo_priority:
        try:
            scheduled = os.sched_getscheduler(0), os.sched_getparam(0)
            go_first(fifo_priority)
        except (OSError, AttributeError) as error:
            raise ConfigError(
                f"fifo_priority: this machine does not grant priority {fifo_priority} ({error}). "
                "Allow it (rtprio in /etc/security/limits.conf), or set it to 0."
            ) from None
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(switch_s)
        gc.unfreeze()
        if collects:
            gc.enable()
        if fifo_priority:
            os.sched_setscheduler(0, *scheduled)


@contextmanager
def _ended_by_hand() -> Generator[list[int]]:
    """The first signal to end the process raises `KeyboardInterrupt`, later ones do nothing: none
    once there is anything in what is yielded. On the main thread alone: others set no handlers."""
    heard: list[int] = []
    before: dict[int, Any] = {}

    def end(number: int, _: object) -> None:
        heard.append(number)
        if len(heard) == 1:
            raise KeyboardInterrupt(signal.Signals(number).name)

    here = threading.current_thread() is threading.main_thread()
    try:
        for name in _BY_HAND if here else ():
            handler = signal.getsignal(number := getattr(signal, name, signal.SIGINT))
            # What the process passes over, as under nohup, it goes on to.
            if handler not in (signal.SIG_IGN, None) and number not in before:
                before[number] = handler
                signal.signal(number, end)
        yield heard
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
