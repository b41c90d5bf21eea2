"""Group prepared rows by shape and run the model over their variants."""

import sys
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, NoReturn

import torch
from numpy.typing import NDArray

from pipeline.errors import NumericsError, VLMError
from pipeline.extraction.rows import ReadyRow
from pipeline.vlm.qwen import FrozenVLM


class Encoder:
    """Encodes rows in batches of equal shape; an out-of-memory halves the batch and goes on.

    `batch_size` counts what the model takes: each variant of a row is one.
    """

    def __init__(self, vlm: FrozenVLM, batch_size: int, variants: int = 1) -> None:
        self.batch_size = batch_size
        self._vlm = vlm
        self._variants = variants
        self._waiting: dict[Any, list[ReadyRow]] = defaultdict(list)

    def add(self, row: ReadyRow) -> list[ReadyRow]:
        """Let a row wait for others of its shape; returns a full batch when there is one.

        So that waiting rows stay few, the largest group is handed out when many shapes wait.
        """
        shape = row.variants[0].shape_key
        self._waiting[shape].append(row)
        if len(self._waiting[shape]) >= self._rows:
            return self._waiting.pop(shape)
        if sum(map(len, self._waiting.values())) >= 4 * self._rows:
            return self._waiting.pop(max(self._waiting, key=lambda key: len(self._waiting[key])))
        return []

    def rest(self) -> Iterator[list[ReadyRow]]:
        """What still waits, shape by shape."""
        yield from self._waiting.values()
        self._waiting.clear()

    def encode(self, rows: list[ReadyRow]) -> Iterator[tuple[list[ReadyRow], NDArray[Any]]]:
        """Each batch with its features (row, variant x slot, dim) as they are stored."""
        while rows:
            batch = rows[: self._rows]
            try:
                features = self._features(batch)
            except RuntimeError as error:
                if not _out_of_memory(error):
                    raise
                self._halve(min(self.batch_size, len(batch) * self._variants), error)
                continue
            except NumericsError as error:
                if len(batch) == 1:
                    self._refuse(batch[0], error)
                for one in batch:  # alone, the row that is not finite names itself
                    yield from self.encode([one])
            else:
                yield batch, stored_bits(features)
            rows = rows[len(batch) :]

    @property
    def _rows(self) -> int:
        """Whole rows a batch: at least one, whose variants may then take several passes."""
        return max(1, self.batch_size // self._variants)

    def _features(self, rows: list[ReadyRow]) -> torch.Tensor:
        """The slots (row, variant x slot, dim) of each row, variant after variant."""
        every = [prepared for row in rows for prepared in row.variants]
        passes = [
            self._vlm.encode(every[start : start + self.batch_size])[0]
            for start in range(0, len(every), self.batch_size)
        ]
        features = torch.cat(passes)
        return features.reshape(len(rows), -1, features.shape[-1])

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

    def _halve(self, failed: int, error: RuntimeError) -> None:
        if failed == 1:
            raise VLMError(
                f"out of memory with a single row ({error}). Use a GPU with more memory, a smaller "
                "vlm.image_resize_height and _width, or fewer data.views."
            ) from error
        self.batch_size = failed // 2
        torch.cuda.empty_cache()
        print(f"out of memory: going on with batches of {self.batch_size}", file=sys.stderr)


def _out_of_memory(error: RuntimeError) -> bool:
    """CUDA has an exception of its own; the CPU allocator says it in words."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def stored_bits(features: torch.Tensor) -> NDArray[Any]:
    """Features as the store's array holds them: bfloat16 as its bits."""
    bits = features.view(torch.uint16) if features.dtype == torch.bfloat16 else features
    return bits.contiguous().numpy()
