"""How much there is to do, said before it is done."""

from collections.abc import Sequence
from time import perf_counter

import torch

from pipeline.evaluate.probe.accumulation import Table
from pipeline.evaluate.probe.readers import GROUP_WIDTH

_TRIED = 768
"""Columns of the product that is timed: a few hundredths of a second."""


def foretold(table: Table, sizes: Sequence[int], penalties: int, threads: int) -> str:
    """A line of what is fitted and about how long it takes on this machine.

    `sizes` are the numbers of slots of all that is scored. The time is that of the arithmetic of
    the sums and of the Cholesky factors, at the speed of a matrix product on each thread.
    """
    single = sum(size == 1 for size in sizes)
    parts = len(table.folds.fold_of_part)
    work = sum(_operations(table, size, penalties, parts) for size in sizes)
    seconds = work / (_speed() * threads)
    several = len(sizes) - single
    groups = f" one by one, groups of slots: {several}" if several else ""
    return (
        f"scoring {single} slots{groups}; {len(table.folds.ticks)} ticks, {table.folds.count} "
        f"folds, {penalties} penalties: {_said(seconds)} of arithmetic on {threads} threads"
    )


def _operations(table: Table, slots: int, penalties: int, parts: int) -> float:
    """Floating point operations, of the leading orders."""
    dim = table.store.feature_shape[1]
    inputs = dim if slots == 1 else slots * min(dim, GROUP_WIDTH // slots)
    others = table.beside + table.targets
    sums = 2.0 * len(table.rows) * inputs * (inputs + others)
    # What is trained on: without each part, and without each two of them.
    fits = parts * (parts + 1) / 2
    factors = fits * penalties * (inputs**3 / 3 + 2.0 * inputs**2 * others)
    tests = parts**2 * penalties * 2 * 2.0 * (inputs + table.beside) ** 2 * table.targets
    return sums + factors + tests


def _speed() -> float:
    """Operations a second of a product in float64, on the threads that linear algebra has now."""
    square = torch.ones((_TRIED, _TRIED), dtype=torch.float64)
    torch.mm(square, square)
    start = perf_counter()
    torch.mm(square, square)
    return 2.0 * _TRIED**3 / (perf_counter() - start)


def _said(seconds: float) -> str:
    if seconds < 10:
        return "a few seconds"
    if seconds < 90:
        return f"about {round(seconds, -1):.0f} s"
    return f"about {seconds / 60:.0f} min"
