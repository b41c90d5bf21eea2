"""What goes on beside the ticks of a robot's loop: readings that wait, the policy's thread, a clock
and a watchdog. Numpy only."""

import math
import os
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ServerBusy
from pipeline.robot.loop import SafeStop, StopKind

Answer = Mapping[str, Any]
_FIRST_OBSERVATIONS = 10
"""Of which the quickest one tells the offset of the robot's clock."""


class PendingReadings:
    """The readings of a stream since the last question: the newest, where there are too many."""

    def __init__(self, readings: int, channels: int) -> None:
        self._channels, self.dropped = channels, 0
        self.pending: deque[tuple[NDArray[np.float32], float]] = deque(maxlen=readings)
        self.forget()

    newest_s: float | None

    def forget(self) -> None:
        """None is pending, and none was ever seen."""
        self.pending.clear()
        self.newest_s = None

    def take_in(
        self, name: str, values: NDArray[Any], time_s: NDArray[Any], latest_s: float
    ) -> None:
        """Raises `SafeStop` for readings that are no numbers, of the future, or not in order."""
        wanted = (len(time_s), self._channels)
        if values.shape != wanted:
            raise SafeStop(StopKind.ROBOT, f"{name}: expected {wanted}, found {values.shape}")
        if not (np.isfinite(values).all() and np.isfinite(time_s).all()):
            raise SafeStop(StopKind.NOT_A_NUMBER, f"{name}: a reading or its time is not a number")
        before = -math.inf if self.newest_s is None else self.newest_s
        if time_s[0] < before or (np.diff(time_s) < 0).any():
            raise SafeStop(StopKind.CLOCK, f"{name}: a reading is older than the one before it")
        if time_s[-1] > latest_s:
            ahead = time_s[-1] - latest_s
            raise SafeStop(StopKind.CLOCK, f"{name}: a reading is of the future, by {ahead:.3f} s")
        self.newest_s = float(time_s[-1])
        came = len(self.pending) + len(time_s)
        self.pending.extend(zip(np.array(values, np.float32), map(float, time_s), strict=True))
        self.dropped += came - len(self.pending)

    def hand_over(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """The pending readings and their times, which then are no longer pending."""
        values, times = zip(*self.pending, strict=True)
        self.pending.clear()
        return np.stack(values), np.array(times)


class RobotClock:
    """The robot's clock beside ours.

    Its offset is taken once. A crystal of its own, 50 ppm off, has left it by 0.1 s (`drift_s` as
    it is by default) after some 33 minutes. For longer runs keep the robot's clock to ours (NTP,
    PTP), let the robot tell times of `time.monotonic()`, or allow more drift.
    """

    def __init__(self, offset_s: float | None, drift_s: float) -> None:
        """`offset_s` is the robot's clock less ours; None: the first observations tell it."""
        self._declared, self._drift_s = offset_s, drift_s
        self.offset_s = -math.inf if offset_s is None else offset_s
        self._seen = 0

    def now_s(self) -> float:
        """What the robot's clock says now, if it has kept its offset."""
        return time.monotonic() + self.offset_s

    def check(self, told_s: float) -> None:
        """Compare what the robot tells. Raises `SafeStop` where the clocks have parted."""
        offset = told_s - time.monotonic()
        self._seen += 1
        if self._declared is None and self._seen <= _FIRST_OBSERVATIONS:
            # What took the least time to come here is the least behind.
            self.offset_s = max(self.offset_s, offset)
        if not abs(offset - self.offset_s) <= self._drift_s:
            said = f"the robot's clock is {offset - self.offset_s:+.3f} s from where it was"
            raise SafeStop(StopKind.CLOCK, said)


class Asker:
    """Asks the policy on a thread of its own, one question at a time."""

    def __init__(self, infer: Callable[[Mapping[str, Any]], Answer], fifo_priority: int) -> None:
        self._infer, self._priority = infer, fifo_priority
        self._questions: SimpleQueue[Mapping[str, Any] | None] = SimpleQueue()
        self._answers: SimpleQueue[tuple[float, Answer | Exception]] = SimpleQueue()
        self.busy = self.stale = False
        self.took_s = 0.0
        self._thread = threading.Thread(target=self._serve, name="policy", daemon=True)
        self._thread.start()

    def ask(self, question: Mapping[str, Any]) -> None:
        """Put a question, where none is being answered."""
        self.busy = True
        self._questions.put(question)

    def take(self) -> Answer | None:
        """The answer where it has come. Raises `SafeStop` where the policy failed, `ServerBusy`
        where it will not answer this question."""
        try:
            self.took_s, answer = self._answers.get_nowait()
        except Empty:
            return None
        self.busy = False
        if not isinstance(answer, Exception):
            return answer
        if isinstance(answer, ServerBusy):
            raise answer
        lost = isinstance(answer, ConnectionError)
        kind = StopKind.CONNECTION if lost else StopKind.POLICY
        raise SafeStop(kind, f"{kind.value}: {type(answer).__name__}: {answer}") from answer

    def close(self) -> None:
        """Ask no more; an answer that takes long is left alone."""
        self._questions.put(None)
        self._thread.join(timeout=5.0)

    def _serve(self) -> None:
        if self._priority > 0:
            go_first(self._priority)
        while (question := self._questions.get()) is not None:
            began = time.monotonic()
            try:
                answer = self._infer(question)
            except Exception as error:
                answer = error
            self._answers.put((time.monotonic() - began, answer))


class Watchdog:
    """Stops the robot where the loop makes no tick any more.

    It counts its own looks and not seconds, so that a process that was stopped as a whole, and
    goes on, is not taken for a loop that hangs.
    """

    LOOKS = 5

    def __init__(self, stop: Callable[[str], object], hung_s: float) -> None:
        self._stop, self._hung_s = stop, hung_s
        self._beats = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self.reason = self.failed = ""
        """Why it has stopped the robot, and the tracebacks where that raised."""

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def beat(self) -> None:
        """A tick has ended."""
        self._beats += 1

    def check(self) -> None:
        """Raise `SafeStop` where it has stopped the robot."""
        if self.reason:
            raise SafeStop(StopKind.HUNG, self.reason)

    def close(self) -> None:
        """Look no more."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=1.0)

    def _watch(self) -> None:
        looks, seen = 0, -1
        while not self._closed.wait(self._hung_s / self.LOOKS):
            looks, seen = (0 if self._beats != seen else looks + 1), self._beats
            if looks == self.LOOKS and not self.reason:
                self.reason = f"no tick has ended for {self._hung_s:g} s"
                self.failed = stop_firmly(self._stop, self.reason)


def stop_firmly(stop: Callable[[str], object], reason: str) -> str:
    """Stop the robot, once more where that raises; the tracebacks, empty where all went well."""
    failed = ""
    for _ in range(2):
        try:
            stop(reason)
            break
        except Exception:
            failed += f"robot.stop failed: {traceback.format_exc()}"
    return failed


def go_first(fifo_priority: int) -> None:
    """This thread, and those that it starts, go before whatever has less priority."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(fifo_priority))
