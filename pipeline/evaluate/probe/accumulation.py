"""One pass over the rows: what a regression has to know of them, part by part of the folds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.evaluate.probe.folds import Folds
from pipeline.evaluate.probe.moments import Moments
from pipeline.evaluate.probe.readers import Reader, check
from pipeline.policy.normalization import fit_channels
from pipeline.store import FeatureStore

_BLOCK_BYTES = 64 * 2**20
_BLOCK_ROWS = 2048
"""A block of rows is bounded by both: by what is read, and by what it becomes in float64."""
_LEAST_ROWS = 64


@dataclass(frozen=True, eq=False)
class Block:
    """Some VL rows of one part, and what belongs to the ticks that use them."""

    rows: NDArray[np.int64]
    ticks: NDArray[np.int64]
    """(row,) how many ticks that are read use each."""
    beside: Tensor
    """(tick, column): state + sensor, then the action chunk (step x channel), standardised."""

    @cached_property
    def sums(self) -> Tensor:
        """(row, column) of `beside` over the ticks of each row."""
        starts = np.concatenate([[0], np.cumsum(self.ticks)[:-1]])
        return torch.from_numpy(np.add.reduceat(self.beside.numpy(), starts, axis=0))

    @cached_property
    def moments(self) -> Moments:
        """Of `beside` alone, over all ticks."""
        return _moments(self.beside)


class Table:
    """The ticks of every part with what is predicted and what is known beside the features.

    `summaries` (tick, column) are those of `summarize` at the ticks of the folds.
    Nothing here grows with the ticks but their numbers and the file of `summaries`.
    """

    def __init__(
        self, store: FeatureStore, folds: Folds, summaries: NDArray[np.float32], horizon: int
    ) -> None:
        self.store = store
        self.folds = folds
        self.beside = summaries.shape[1]
        self.targets = horizon * store.action_dim
        self._summaries = summaries
        self._steps = np.arange(horizon)
        names = store.streams["action"]["names"]
        # Over all that is read, so that every fold is scored in one unit; fitting has its own.
        self._action = fit_channels([store.array("tick/action")], "actions", names)
        self._vl_row = store.array("tick/vl_row")[folds.ticks]

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """The VL rows that the ticks use, ascending."""
        return np.unique(self._vl_row)

    @cached_property
    def row_fold(self) -> NDArray[np.int64]:
        """(row,) of `rows`, the fold that each is held out in."""
        first = np.unique(self._vl_row, return_index=True)[1]
        return self.folds.fold[first]

    def valid_share(self, slots: Sequence[int]) -> float:
        """The share of ticks at which one of these slots is valid."""
        valid = self.store.array("vl/slot_valid")[:, list(slots)].max(axis=1)
        return float(np.count_nonzero(valid[self._vl_row])) / len(self._vl_row)

    def moments(self, part: int, readers: Sequence[Reader]) -> list[Moments]:
        """Of each reader's inputs, what is beside them and the targets, over the rows of a part.

        The slots of the readers follow one another in the store and are read once for all. A row
        counts once for each tick that uses it, as if it stood there as often, where one of the
        reader's slots is valid. Raises `NumericsError` on NaN or inf, naming the place.
        """
        slots = [slot for reader in readers for slot in reader.slots]
        first, stop = (min(slots), max(slots) + 1) if slots else (0, 0)
        features = self.store.array("vl/features")
        width = self.beside + self.targets
        sums = [_Sums(reader.width, width) for reader in readers]
        row_bytes = features.dtype.itemsize * features.shape[2] * (stop - first)
        rows = min(_BLOCK_ROWS, max(_LEAST_ROWS, _BLOCK_BYTES // (row_bytes + 1)))
        for block in self._blocks(part, rows):
            values = features[block.rows, first:stop]
            valid = self.store.array("vl/slot_valid")[block.rows, first:stop].astype(bool)
            check(self.store, block.rows, values, first, valid)
            for reader, each in zip(readers, sums, strict=True):
                own = [slot - first for slot in reader.slots]
                each.add(block, reader(values[:, own], valid[:, own]), valid[:, own])
        return [each.moments() for each in sums]

    def _blocks(self, part: int, rows: int) -> Iterator[Block]:
        at = np.flatnonzero(self.folds.part == part)
        used, starts, counts = np.unique(self._vl_row[at], return_index=True, return_counts=True)
        edges = np.append(starts, len(at))
        for first in range(0, len(used), rows):
            last = min(first + rows, len(used))
            inside = at[edges[first] : edges[last]]
            yield Block(used[first:last], counts[first:last], self._beside(inside))

    def _beside(self, at: NDArray[np.int64]) -> Tensor:
        chunk = self.store.array("tick/action")[self.folds.ticks[at, None] + self._steps]
        target = (chunk.astype(np.float64) - self._action.mean) / self._action.scale
        known = self._summaries[at].astype(np.float64)
        return torch.from_numpy(np.concatenate([known, target.reshape(len(at), -1)], axis=1))


class _Sums:
    """The moments of one reader and one part as they grow."""

    def __init__(self, width: int, beside: int) -> None:
        self._width = width
        self._rows = 0.0
        self._sum = torch.zeros(width + beside, dtype=torch.float64)
        self._gram = torch.zeros((width + beside,) * 2, dtype=torch.float64)

    def add(self, block: Block, inputs: Tensor, valid: NDArray[np.bool_]) -> None:
        """Count the rows of a block in which one of the slots is valid; all, of no slots."""
        used = valid.any(axis=1) if valid.shape[1] else np.ones(len(valid), bool)
        ticks = torch.from_numpy(np.where(used, block.ticks, 0)).double()
        beside = block.moments
        if not used.all():
            beside = _moments(block.beside[torch.from_numpy(np.repeat(used, block.ticks))])
        width = self._width
        weighed = inputs * ticks.sqrt()[:, None]
        self._rows += beside.rows
        self._sum[:width] += inputs.T @ ticks
        self._sum[width:] += beside.sum
        self._gram[:width, :width].addmm_(weighed.T, weighed)
        # The inputs of a row that does not count are 0.
        self._gram[:width, width:].addmm_(inputs.T, block.sums)
        self._gram[width:, width:] += beside.gram

    def moments(self) -> Moments:
        """What was counted."""
        width = self._width
        self._gram[width:, :width] = self._gram[:width, width:].T
        return Moments(self._rows, self._sum, self._gram)


def _moments(rows: Tensor) -> Moments:
    return Moments(float(len(rows)), rows.sum(dim=0), rows.T @ rows)
