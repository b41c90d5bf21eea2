"""Ctrl-C and SIGTERM, put off to the end of a step."""

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def deferred_interrupt() -> Generator[Callable[[], bool]]:
    """Within it, a first SIGINT or SIGTERM only sets what the yielded function returns.

    A step stopped half-way would leave weights of which some are updated and others not; so the
    loop asks between steps. A second signal raises `KeyboardInterrupt` at once. Outside the main
    thread, where Python delivers no signal, it changes nothing.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(signum: int, frame: FrameType | None) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(signum)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
