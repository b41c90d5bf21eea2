"""Prepared rows -> features, in batches of equal shape and of the fastest size."""

import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any, Literal

import torch
from numpy.typing import NDArray

from pipeline.base.arrays import array_of
from pipeline.base.errors import NumericsError, VLMError
from pipeline.extract.rows import ReadyRow
from pipeline.vlm.preparation import TokenLayout
from pipeline.vlm.qwen import FrozenVLM, Pending

# Smaller batches are slower on any device. If this size does not fit, an out-of-memory halves it.
_FIRST = 8

# Larger batches are not faster and only take memory.
_MOST = {"cpu": 64, "cuda": 512}

# Timed batches per size, after one that warms up.
#
# The fastest counts: other load on the machine makes a batch slower, never faster.
_MEASURED = 3

# How much faster more rows must be to be worth their memory.
_GAIN = 1.03

# The search ends after this many sizes in a row that are no faster: one may be a hiccup.
_MISSES = 2


class BatchSize:
    """The current batch size, in prepared rows.

    A fixed number stays until memory runs out. "auto" doubles the size as long as that makes the
    model a few percent faster, and keeps the smallest of the fastest sizes.
    """

    def __init__(self, size: int | Literal["auto"], device: str = "cpu") -> None:
        """`device` is the type of the model's device."""
        self.current = _FIRST if size == "auto" else size
        self.settled = size != "auto"
        self._most = _MOST[device]
        self._best = (0.0, self.current)
        self._misses = 0
        self._speeds: list[float] = []

    def note(self, size: int, tokens: int, seconds: float) -> None:
        """Note how long a full batch of this size took.

        The speed counts tokens, because rows of another shape have another number of them.
        """
        if self.settled or size != self.current:  # this batch had started before the size changed
            return
        self._speeds.append(tokens / max(seconds, 1e-9))
        if len(self._speeds) <= _MEASURED:
            return
        speed = max(self._speeds[1:])  # the first batch warms up
        self._speeds.clear()
        if speed >= self._best[0] * _GAIN:
            self._best, self._misses = (speed, self.current), 0
        else:
            self._misses += 1
        self.settled = self._misses == _MISSES or self.current * 2 > self._most
        self.current = self._best[1] if self.settled else self.current * 2

    def halve(self, failed: int, error: RuntimeError) -> None:
        """Continue with half of the size that did not fit; `VLMError` if that was one row."""
        if failed == 1:
            raise VLMError(
                f"out of memory with a single row ({error}). Use a GPU with more memory, a smaller "
                "vlm.image_resize_height and _width, or fewer data.views."
            ) from error
        self.current, self.settled = min(failed // 2, self._best[1]), True
        torch.cuda.empty_cache()
        print(f"out of memory: going on with batches of {self.current}", file=sys.stderr)


# Rows, and their features (row, variant x slot, dim) as they are stored.
Encoded = tuple[list[ReadyRow], NDArray[Any]]


# Rows that the model works on; their variants in one pass or several; and the batch size if the
# batch is full.
_Submitted = tuple[list[ReadyRow], list[Pending], int | None]


class Encoder:
    """Encodes rows in batches of equal shape; an out-of-memory halves the batch and goes on.

    The batch size counts what the model takes: each variant of a row is one.
    """

    def __init__(
        self, vlm: FrozenVLM, batch_size: int | Literal["auto"], variants: int = 1
    ) -> None:
        """With "auto" the first batches are timed, and the fastest size is kept."""
        self.model_s = 0.0  # seconds the model worked on the features returned so far
        self._vlm = vlm
        self.size = BatchSize(batch_size, vlm.device.type)
        self._variants = variants

    def encoded(self, rows: Iterable[ReadyRow]) -> Iterator[Encoded]:
        """Every row once, batch by batch, in any order.

        On a GPU one batch is computed while the caller works on the previous one. Raises
        `NumericsError`, which names the row and variant of a feature that is not finite, and
        `VLMError` where a single row does not fit in memory.
        """
        ahead: list[_Submitted] = []
        for batch in self._batches(rows):
            for submitted in self._submitted(batch):
                ahead.append(submitted)
                keep = 0 if all(part.done for part in submitted[1]) else 1
                while len(ahead) > keep:
                    yield from self._finished(ahead.pop(0))
        for submitted in ahead:
            yield from self._finished(submitted)

    def _batches(self, rows: Iterable[ReadyRow]) -> Iterator[list[ReadyRow]]:
        """Batches of equal shape as soon as they are full; at the end the rest of each shape.

        When too many rows of different shapes wait, the largest group is computed first.
        """
        waiting: dict[TokenLayout, list[ReadyRow]] = defaultdict(list)
        for row in rows:
            layout = row.variants[0].layout
            waiting[layout].append(row)
            if len(waiting[layout]) >= self._rows:
                yield waiting.pop(layout)
            elif sum(map(len, waiting.values())) >= 4 * self._rows:
                yield waiting.pop(max(waiting, key=lambda key: len(waiting[key])))
        yield from waiting.values()

    @property
    def _rows(self) -> int:
        """Rows per batch: at least one; its variants may take several passes."""
        return max(1, self.size.current // self._variants)

    def _submitted(self, rows: list[ReadyRow]) -> Iterator[_Submitted]:
        """The rows in batches of at most the batch size."""
        while rows:
            batch = rows[: self._rows]
            every = [prepared for row in batch for prepared in row.variants]
            size = self.size.current
            try:
                parts = (every[start : start + size] for start in range(0, len(every), size))
                passes = [self._vlm.submit(part) for part in parts]
            except RuntimeError as error:
                if not _out_of_memory(error):
                    raise
                self.size.halve(min(size, len(every)), error)
                continue
            yield batch, passes, size if len(batch) == self._rows else None
            rows = rows[len(batch) :]

    def _finished(self, submitted: _Submitted) -> Iterator[Encoded]:
        rows, passes, full = submitted
        try:
            features = [part.result()[0] for part in passes]
        except NumericsError:
            for row in rows:  # one by one, so that the error names the row
                yield [row], _stored([row], [self._alone(row, v) for v in range(self._variants)])
            return
        seconds = sum(part.model_s for part in passes)
        self.model_s += seconds
        if full is not None:
            tokens = len(rows) * self._variants * rows[0].variants[0].layout.length
            self.size.note(full, tokens, seconds)
        yield rows, _stored(rows, features)

    def _alone(self, row: ReadyRow, variant: int) -> torch.Tensor:
        try:
            return self._vlm.encode([row.variants[variant]])[0]
        except NumericsError as error:
            which = f", variant {variant}" if self._variants > 1 else ""
            raise NumericsError(f"{row.where}{which}: {error}") from None


def _stored(rows: list[ReadyRow], features: list[torch.Tensor]) -> NDArray[Any]:
    """Features (row x variant, slot, dim) as the rows are stored."""
    joined = torch.cat(features)
    return array_of(joined.reshape(len(rows), -1, joined.shape[-1]))


def _out_of_memory(error: RuntimeError) -> bool:
    """CUDA raises an exception of its own; the CPU allocator has only a message."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)
