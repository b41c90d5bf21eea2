"""How many rows the model takes at a time: found by measuring, halved when memory runs out."""

import sys
from typing import Literal

import torch

from pipeline.base.errors import VLMError

_FIRST = 8
"""Fewer are slower on any device; where they do not fit, memory running out says so."""

_MOST = {"cpu": 64, "cuda": 512}
"""Past these, more rows gain nothing and only hold memory."""

_MEASURED = 3
"""Batches of a size that are timed; the one before them warms up.

The fastest counts: whatever else the machine does makes a batch slower, never faster.
"""

_GAIN = 1.03
"""How much faster more rows must be to be worth their memory."""

_MISSES = 2
"""Sizes in a row that are no faster before the search ends: one may be a hiccup."""


class BatchSize:
    """The current batch size, of prepared rows.

    A number stays until memory runs out. "auto" doubles as long as that makes the model faster by
    a few percent; then the smallest of the fastest sizes stays.
    """

    def __init__(self, size: int | Literal["auto"], device: str = "cpu") -> None:
        """`device` is the type of the one that the model is on."""
        self.current = _FIRST if size == "auto" else size
        self.settled = size != "auto"
        self._most = _MOST[device]
        self._best = (0.0, self.current)
        self._misses = 0
        self._warm = False
        self._timed: list[tuple[int, float]] = []

    def note(self, size: int, tokens: int, seconds: float) -> None:
        """What a full batch of this size took.

        Tokens, not rows, are counted: rows of another shape have more of them.
        """
        if self.settled or size != self.current:  # one more was under way when it changed
            return
        if not self._warm:
            self._warm = True
            return
        self._timed.append((tokens, seconds))
        if len(self._timed) == _MEASURED:
            self._decide(max(tokens / max(seconds, 1e-9) for tokens, seconds in self._timed))

    def halve(self, failed: int, error: RuntimeError) -> None:
        """Go on with half of what did not fit; `VLMError` where that was a single row."""
        if failed == 1:
            raise VLMError(
                f"out of memory with a single row ({error}). Use a GPU with more memory, a smaller "
                "vlm.image_resize_height and _width, or fewer data.views."
            ) from error
        self._settle(min(failed // 2, self._best[1]))
        torch.cuda.empty_cache()
        print(f"out of memory: going on with batches of {self.current}", file=sys.stderr)

    def _decide(self, speed: float) -> None:
        if speed >= self._best[0] * _GAIN:
            self._best, self._misses = (speed, self.current), 0
        else:
            self._misses += 1
        if self._misses == _MISSES or self.current * 2 > self._most:
            self._settle(self._best[1])
        else:
            self.current *= 2
            self._warm, self._timed = False, []

    def _settle(self, size: int) -> None:
        self.current, self.settled = size, True
