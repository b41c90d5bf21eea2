"""The first signal waits for the end of a step, the second does not."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from pipeline.train.loop import deferred_interrupt


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_is_noted_and_the_second_stops_at_once(number):
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), deferred_interrupt() as interrupted:
        assert not interrupted()
        os.kill(os.getpid(), number)
        assert interrupted()
        os.kill(os.getpid(), number)
        pytest.fail("the second signal went unheard")
    assert signal.getsignal(number) is before


def test_outside_the_main_thread_nothing_changes():
    def work() -> tuple[bool, bool]:
        before = signal.getsignal(signal.SIGINT)
        with deferred_interrupt() as interrupted:
            return interrupted(), signal.getsignal(signal.SIGINT) is before

    with ThreadPoolExecutor(1) as thread:
        assert thread.submit(work).result() == (False, True)
