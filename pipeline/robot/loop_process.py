"""The process of a robot's loop: two threads beside the loop, and its signals."""

import gc
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import Any

from pipeline.robot.loop import SafeStop, StopKind

Answer = Mapping[str, Any]

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SWITCH_S = 5e-4
"""How long another thread of this process may hold Python while the loop waits for it."""


class PolicyThread:
    """Asks the policy on a thread of its own, one question at a time."""

    def __init__(self, infer: Callable[[Mapping[str, Any]], Answer]) -> None:
        self._infer = infer
        self._questions: SimpleQueue[Mapping[str, Any] | None] = SimpleQueue()
        self._answers: SimpleQueue[tuple[float, Answer | Exception]] = SimpleQueue()
        self.busy = self._stale = False
        self.took_s = 0.0
        """How long the newest answer took."""
        self._thread = threading.Thread(target=self._serve, name="policy", daemon=True)
        self._thread.start()

    def ask(self, question: Mapping[str, Any]) -> None:
        """Send a question; call it only while no answer is awaited."""
        self.busy = True
        self._questions.put(question)

    def forget(self) -> None:
        """Drop the awaited answer, if any, when it comes."""
        self._stale = self.busy

    def take(self) -> Answer | None:
        """The answer if it has come, else None.

        Raises `SafeStop` if the policy failed.
        """
        try:
            self.took_s, answer = self._answers.get_nowait()
        except Empty:
            return None
        stale, self.busy, self._stale = self._stale, False, False
        if isinstance(answer, Exception):
            lost = isinstance(answer, ConnectionError)
            kind = StopKind.CONNECTION if lost else StopKind.POLICY
            raise SafeStop(kind, f"{kind.value}: {type(answer).__name__}: {answer}") from answer
        return None if stale else answer

    def close(self) -> None:
        """Ask no more; wait for an awaited answer, but at most 5 s."""
        self._questions.put(None)
        self._thread.join(timeout=5.0)

    def _serve(self) -> None:
        while (question := self._questions.get()) is not None:
            self._answer(question)

    def _answer(self, question: Mapping[str, Any]) -> None:
        began = time.monotonic()
        try:
            answer = self._infer(question)
        except Exception as error:
            answer = error
        self._answers.put((time.monotonic() - began, answer))


class Watchdog:
    """Stops the robot when the loop hangs, so that no tick ends any more.

    It counts its own looks and not seconds. So a process that was suspended as a whole, and then
    resumed, does not count as a loop that hangs.
    """

    LOOKS = 5

    def __init__(self, stop: Callable[[str], object], hung_s: float) -> None:
        self._stop, self._hung_s = stop, hung_s
        self._beats = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self.reason = self.failed = ""
        """Why it has stopped the robot, and the tracebacks if stopping raised errors."""
        self._thread.start()

    def beat(self) -> None:
        """Note that a tick has ended."""
        self._beats += 1

    def check(self) -> None:
        """Raise `SafeStop` if the watchdog has stopped the robot."""
        if self.reason:
            raise SafeStop(StopKind.HUNG, self.reason)

    def close(self) -> None:
        """Stop watching."""
        self._closed.set()
        self._thread.join(timeout=1.0)

    def _watch(self) -> None:
        looks, seen = 0, -1
        while not self._closed.wait(self._hung_s / self.LOOKS):
            looks, seen = (0 if self._beats != seen else looks + 1), self._beats
            if looks == self.LOOKS and not self.reason:
                self.reason = f"no tick has ended for {self._hung_s:g} s"
                self.failed = stop_firmly(self._stop, self.reason)


def stop_firmly(stop: Callable[[str], object], reason: str) -> str:
    """Stop the robot; try once more if that raises. Returns the tracebacks, else an empty text."""
    failed = ""
    for _ in range(2):
        try:
            stop(reason)
            break
        except Exception:
            failed += f"robot.stop failed: {traceback.format_exc()}"
    return failed


@contextmanager
def undisturbed() -> Generator[None]:
    """Run this thread without garbage collection, which the loop does not need.

    Other threads hold Python for half a millisecond at most.
    """
    switch_s, collects = sys.getswitchinterval(), gc.isenabled()
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


@contextmanager
def ended_by_hand() -> Generator[list[str]]:
    """Raise `KeyboardInterrupt` at the first signal that ends the process; ignore later ones.

    The yielded list gets the names of the signals; as soon as it is not empty, signals are ignored.
    Only the main thread can set handlers; in another thread, signals act as before.
    """
    ended: list[str] = []
    before: dict[int, Any] = {}

    def end(number: int, _: object) -> None:
        ended.append(signal.Signals(number).name)
        if len(ended) == 1:
            raise KeyboardInterrupt(ended[0])

    here = threading.current_thread() is threading.main_thread()
    try:
        for number in _SIGNALS if here else ():
            handler = signal.getsignal(number)
            # A signal that the process ignores, as under nohup, stays ignored.
            if handler not in (signal.SIG_IGN, None):
                before[number] = handler
                signal.signal(number, end)
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
