"""Group prepared rows by shape and run the model over them."""

import sys
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import torch
from numpy.typing import NDArray

from pipeline.errors import NumericsError, VLMError
from pipeline.extraction.rows import ReadyRow
from pipeline.vlm.qwen import FrozenVLM


class Encoder:
    """Encodes rows in batches of equal shape; an out-of-memory halves the batch and goes on."""

    def __init__(self, vlm: FrozenVLM, batch_size: int) -> None:
        self.batch_size = batch_size
        self._vlm = vlm
        self._waiting: dict[Any, list[ReadyRow]] = defaultdict(list)

    def add(self, row: ReadyRow) -> list[ReadyRow]:
        """Let a row wait for others of its shape; returns a full batch when there is one.

        So that waiting rows stay few, the largest group is handed out when many shapes wait.
        """
        group = self._waiting[row.prepared.shape_key]
        group.append(row)
        if len(group) >= self.batch_size:
            return self._waiting.pop(row.prepared.shape_key)
        if sum(map(len, self._waiting.values())) >= 4 * self.batch_size:
            return self._waiting.pop(max(self._waiting, key=lambda key: len(self._waiting[key])))
        return []

    def rest(self) -> Iterator[list[ReadyRow]]:
        """What still waits, shape by shape."""
        yield from self._waiting.values()
        self._waiting.clear()

    def encode(self, rows: list[ReadyRow]) -> Iterator[tuple[list[ReadyRow], NDArray[Any]]]:
        """Each batch with its features (row, slot, dim) as they are stored."""
        while rows:
            batch = rows[: self.batch_size]
            try:
                features, _ = self._vlm.encode([one.prepared for one in batch])
            except RuntimeError as error:
                if not _out_of_memory(error):
                    raise
                self._halve(len(batch), error)
                continue
            except NumericsError as error:
                if len(batch) == 1:
                    raise NumericsError(f"{batch[0].where}: {error}") from None
                for one in batch:  # alone, the row that is not finite names itself
                    yield from self.encode([one])
            else:
                yield batch, stored_bits(features)
            rows = rows[len(batch) :]

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
