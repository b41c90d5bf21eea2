"""Group prepared rows by shape and run the model over their variants."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

import torch
from numpy.typing import NDArray

from pipeline.base.errors import NumericsError
from pipeline.extract.batch_size import BatchSize
from pipeline.extract.rows import ReadyRow
from pipeline.vlm.preparation import TokenLayout
from pipeline.vlm.qwen import FrozenVLM, Pending

Encoded = tuple[list[ReadyRow], NDArray[Any]]
"""Rows, and their features (row, variant x slot, dim) as they are stored."""


@dataclass(frozen=True)
class _Submitted:
    """Rows that the model works on, variant after variant, in one pass or several."""

    rows: list[ReadyRow]
    passes: list[Pending]
    full: int | None
    """The batch size, where there are as many rows as it allows."""


class Encoder:
    """Encodes rows in batches of equal shape; an out-of-memory halves the batch and goes on.

    The batch size counts what the model takes: each variant of a row is one.
    """

    def __init__(
        self, vlm: FrozenVLM, batch_size: int | Literal["auto"], variants: int = 1
    ) -> None:
        """With "auto" the first batches are measured, and the size settles where it is fastest."""
        self.model_s = 0.0
        """Seconds that the model worked on what was handed out so far."""
        self._vlm = vlm
        self._size = BatchSize(batch_size, vlm.device.type)
        self._variants = variants

    @property
    def batch_size(self) -> int:
        """How many prepared rows the model takes at a time, as of now."""
        return self._size.current

    @property
    def settled(self) -> bool:
        """Whether only memory running out would change the batch size."""
        return self._size.settled

    def encoded(self, rows: Iterable[ReadyRow]) -> Iterator[Encoded]:
        """Every row once, batch by batch as the model is done with them, in no given order.

        On a GPU one batch is ahead of what is handed out, so that it works while the caller does;
        what is done is not held back. Raises
        `NumericsError` that names the row, and variant, of a feature that is not finite, and
        `VLMError` where memory does not suffice for a single row.
        """
        ahead: _Submitted | None = None
        for batch in self._batches(rows):
            for submitted in self._submitted(batch):
                if ahead is not None:
                    yield from self._finished(ahead)
                ahead = submitted
                if all(one.done for one in submitted.passes):
                    yield from self._finished(ahead)
                    ahead = None
        if ahead is not None:
            yield from self._finished(ahead)

    def _batches(self, rows: Iterable[ReadyRow]) -> Iterator[list[ReadyRow]]:
        """Full batches of equal shape as they come together, at last what is left of each shape.

        So that waiting rows stay few, the largest group goes when many shapes wait.
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
        """Whole rows a batch: at least one, whose variants may then take several passes."""
        return max(1, self.batch_size // self._variants)

    def _submitted(self, rows: list[ReadyRow]) -> Iterator[_Submitted]:
        """The rows in as many batches as the batch size makes of them."""
        while rows:
            batch = rows[: self._rows]
            every = [prepared for row in batch for prepared in row.variants]
            size = self.batch_size
            try:
                parts = (every[start : start + size] for start in range(0, len(every), size))
                passes = [self._vlm.submit(part) for part in parts]
            except RuntimeError as error:
                if not _out_of_memory(error):
                    raise
                self._size.halve(min(size, len(every)), error)
                continue
            yield _Submitted(batch, passes, size if len(batch) == self._rows else None)
            rows = rows[len(batch) :]

    def _finished(self, submitted: _Submitted) -> Iterator[Encoded]:
        rows = submitted.rows
        try:
            features = torch.cat([one.result()[0] for one in submitted.passes])
        except NumericsError as error:
            if len(rows) == 1:
                self._refuse(rows[0], error)
            for one in rows:  # alone, the row that is not finite names itself
                for alone in self._submitted([one]):
                    yield from self._finished(alone)
            return
        seconds = sum(one.model_s for one in submitted.passes)
        self.model_s += seconds
        if submitted.full is not None:
            tokens = len(rows) * self._variants * rows[0].variants[0].layout.length
            self._size.note(submitted.full, tokens, seconds)
        yield rows, stored_bits(features.reshape(len(rows), -1, features.shape[-1]))

    def _refuse(self, row: ReadyRow, error: NumericsError) -> NoReturn:
        where = row.where
        if self._variants > 1:
            where += f", variant {self._not_finite(row)}"
        raise NumericsError(f"{where}: {error}") from None

    def _not_finite(self, row: ReadyRow) -> str:
        for variant, prepared in enumerate(row.variants):
            try:
                self._vlm.encode([prepared])
            except NumericsError:
                return str(variant)
        return "unknown (each is finite alone)"


def _out_of_memory(error: RuntimeError) -> bool:
    """CUDA has an exception of its own; the CPU allocator says it in words."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def stored_bits(features: torch.Tensor) -> NDArray[Any]:
    """Features as the store's array holds them: bfloat16 as its bits."""
    bits = features.view(torch.uint16) if features.dtype == torch.bfloat16 else features
    return bits.contiguous().numpy()
