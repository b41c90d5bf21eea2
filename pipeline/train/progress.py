"""How far a training is while it runs: a bar on a terminal, a line a minute anywhere else."""

import sys
from collections.abc import Callable
from time import monotonic
from typing import NoReturn, Self

from tqdm import tqdm

from pipeline.base.format import duration

EVERY_S = 60.0
"""Between two lines."""


class Progress:
    """Counts steps on stderr, `shown` on one process of several."""

    def __init__(self, step: int, total: int, shown: bool) -> None:
        # None: shown where stderr is a terminal.
        hidden = None if shown else True
        self._bar: tqdm[NoReturn] = tqdm(initial=step, total=total, unit="step", disable=hidden)
        self._writes_lines = shown and self._bar.disable
        self._step, self._total = step, total
        self._last_line = step, monotonic()

    def advance(self, loss: Callable[[], float]) -> None:
        """Count a step; `loss` gives its loss, and is only asked where a line is due."""
        self._step += 1
        self._bar.update()
        step, since = self._last_line
        elapsed = monotonic() - since
        if not self._writes_lines or elapsed < EVERY_S:
            return
        steps_per_s = (self._step - step) / elapsed
        left = duration((self._total - self._step) / steps_per_s)
        print(
            f"step {self._step} of {self._total}: train loss {loss():.4f}, "
            f"{steps_per_s:.3g} steps/s, about {left} left",
            file=sys.stderr,
            flush=True,
        )
        self._last_line = self._step, monotonic()

    def note(self, **values: str) -> None:
        """Show these behind the bar."""
        self._bar.set_postfix(values)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._bar.close()
