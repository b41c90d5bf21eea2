"""95 % intervals by the bootstrap over groups (Efron and Tibshirani 1993, chapters 6 and 13).

Ticks of one recording are alike, so the unit that is drawn anew is a group of recordings. Figures
of several methods on the same groups are drawn together: the difference of their draws is the
paired bootstrap.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

DRAWS = 2000
FEWEST_GROUPS = 2
"""Of fewer groups there is nothing to draw: they give no interval."""


def bootstrap_means(
    sums: NDArray[np.floating], counts: NDArray[np.floating], draws: int = DRAWS, seed: int = 0
) -> NDArray[np.float64]:
    """Means (draw, figure) over as many groups, drawn with replacement.

    `sums` (group, figure) and `counts` (group, figure), or (group, 1) for all figures, add up to
    sum / count. NaN where a draw counts nothing. The same seed draws the same groups, whatever
    the figures.
    """
    sums, counts = np.asarray(sums, np.float64), np.asarray(counts, np.float64)
    times = _draw(len(sums), draws, seed)
    total, count = times @ sums, times @ counts
    count = np.broadcast_to(count, total.shape)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


@lru_cache(maxsize=4)
def _draw(groups: int, draws: int, seed: int) -> NDArray[np.float64]:
    """How often each group is drawn: (draw, group)."""
    chances = np.full(groups, 1 / groups)
    return np.random.default_rng(seed).multinomial(groups, chances, draws).astype(np.float64)


def interval(draws: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The 2.5th and 97.5th percentiles along the first axis; NaN draws are left out."""
    draws = np.asarray(draws, np.float64)
    nothing = np.isnan(draws).all(axis=0)
    low, high = np.nanpercentile(np.where(nothing, 0.0, draws), [2.5, 97.5], axis=0)
    return np.where(nothing, np.nan, low), np.where(nothing, np.nan, high)
