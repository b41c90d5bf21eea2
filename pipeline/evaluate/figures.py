"""Figures with their 95 % intervals: errors, differences and ratios, by one bootstrap over groups.

Ticks of one recording are alike, so the bootstrap draws whole groups of recordings (Efron and
Tibshirani 1993, chapters 6 and 13). All figures draw the same groups, so the difference of two
figures' draws is the paired bootstrap.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.evaluate.baselines import BASELINES
from pipeline.train.scores import ActionGroup, Comparison, Errors, summed

Draws = NDArray[np.float64]
DRAWS = 2000
FEWEST_GROUPS = 2
"""Fewer groups give no interval: there is nothing to draw."""
NO_INTERVAL = "intervals take at least two groups of test recordings"


@dataclass(frozen=True)
class Figure:
    """A number and its 95 % interval, None where there is none."""

    value: float
    low: float | None = None
    high: float | None = None

    @classmethod
    def of(cls, value: float, draws: Draws | None) -> "Figure":
        """The value with the 2.5th and 97.5th percentiles of its draws (draw,), NaN left out."""
        if draws is None or np.isnan(draws).all():
            return cls(value)
        return cls(value, *np.nanpercentile(draws, [2.5, 97.5]).tolist())

    def text(self, sign: str = "") -> str:
        """The figure as `0.279 (0.251–0.304)`; with a `sign` of `+`, as `-0.02 (-0.05 to +0.01)`.

        All numbers have the same decimals, so many that the largest has three digits.
        """
        ends = [end for end in (self.low, self.high) if end is not None]
        largest = max(map(abs, (self.value, *ends)))
        if math.isnan(self.value) or largest == 0:
            return "–" if math.isnan(self.value) else "0"
        decimals = min(max(0, 2 - math.floor(math.log10(largest))), 9)
        value, *words = (f"{number:{sign}.{decimals}f}" for number in (self.value, *ends))
        return f"{value} ({(' to ' if sign else '–').join(words)})" if words else value

    @property
    def resolved(self) -> bool | None:
        """For a difference: whether its interval excludes 0; None without an interval."""
        return None if self.low is None or self.high is None else not self.low <= 0 <= self.high

    @property
    def verdict(self) -> str:
        """`resolved` in a word or two; empty without an interval."""
        return {None: "", True: "resolved", False: "not resolved"}[self.resolved]

    def document(self, name: str = "value") -> dict[str, float]:
        """The figure for a JSON document, with 6 significant digits, without what is None."""
        numbers = {name: self.value, "low": self.low, "high": self.high}
        return {key: float(f"{x:.6g}") for key, x in numbers.items() if x is not None}

    def columns(self, name: str) -> dict[str, float | None]:
        """The figure as columns of a table."""
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


@dataclass(frozen=True)
class Rivalry:
    """The policy, compared with the baseline that is best in this very figure."""

    policy: Figure
    best: str
    baseline: Figure
    difference: Figure
    """The policy's error minus the baseline's, by the paired bootstrap."""

    @property
    def ratio(self) -> float | None:
        """The policy's error divided by the baseline's; None where the baseline's is 0."""
        return self.policy.value / self.baseline.value if self.baseline.value > 0 else None

    @property
    def verdict(self) -> str:
        """`better`, `worse` or `not resolved`; `no interval` without an interval."""
        if self.difference.resolved is None:
            return "no interval"
        if not self.difference.resolved:
            return "not resolved"
        return "better" if self.difference.value < 0 else "worse"


def by_group(comparison: Comparison, values: NDArray[np.floating]) -> Errors:
    """Sums over the cells of each group: (cell, …) -> (group, …), the groups by name."""
    _, place = np.unique(comparison.cells.group, return_inverse=True)
    return summed(values, place)


def sums_by_group(
    comparison: Comparison, method: str, group: ActionGroup | None = None
) -> tuple[Errors, Errors]:
    """Sums of errors and numbers of entries, both (group,); their ratio is `Comparison.error`."""
    absolute = comparison.scores[method].absolute.sum(axis=1) @ comparison.weights(group)
    return by_group(comparison, absolute), by_group(comparison, comparison.cells.entries.sum(1))


def error(comparison: Comparison, method: str, group: ActionGroup | None = None) -> Figure:
    """`Comparison.error` with its interval."""
    drawn = draws(*sums_by_group(comparison, method, group))
    return Figure.of(comparison.error(method, group), drawn)


def best_baseline(comparison: Comparison, group: ActionGroup | None = None) -> str:
    """The baseline with the lowest error in this very figure."""
    return min(BASELINES, key=lambda method: comparison.error(method, group))


def rivalry(comparison: Comparison, group: ActionGroup | None = None) -> Rivalry:
    """The policy and the best baseline in this figure."""
    best = best_baseline(comparison, group)
    policy, baseline = (error(comparison, method, group) for method in ("policy", best))
    (sums, counts), (others, _) = (sums_by_group(comparison, m, group) for m in ("policy", best))
    apart = Figure.of(policy.value - baseline.value, draws(sums - others, counts))
    return Rivalry(policy, best, baseline, apart)


def times(over: Comparison, under: Comparison) -> Figure | None:
    """The policy's overall error in `over` in multiples of that in `under`, on the same ticks.

    The interval is by the paired bootstrap. None if the error in `under` is 0.
    """
    (sums, _), (others, _) = (sums_by_group(which, "policy") for which in (over, under))
    if not others.any():
        return None
    return Figure.of(float(sums.sum() / others.sum()), draws(sums, others))


def mean_over_ticks(values: NDArray[np.floating], groups: NDArray[np.str_]) -> Figure:
    """The mean of `values` (tick,); its interval draws the `groups` (tick,) of the ticks."""
    _, place, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return Figure.of(float(values.mean()), draws(summed(values, place), counts))


def draws(sums: Errors, counts: NDArray[np.number]) -> Draws | None:
    """Bootstrap ratios (draw,) of sums to counts, both (group,); None with too few groups."""
    if len(sums) < FEWEST_GROUPS:
        return None
    return bootstrap_means(sums[:, None], counts[:, None].astype(np.float64))[:, 0]


def bootstrap_means(
    sums: NDArray[np.floating], counts: NDArray[np.floating], draws: int = DRAWS, seed: int = 0
) -> NDArray[np.float64]:
    """Means (draw, figure), each over as many groups as there are, drawn with replacement.

    A mean is the total of the drawn `sums` (group, figure), divided by the total of the drawn
    `counts` (group, figure), or (group, 1) for all figures. NaN if a draw counts nothing. The same
    seed draws the same groups, whatever the figures.
    """
    sums, counts = np.asarray(sums, np.float64), np.asarray(counts, np.float64)
    times_drawn = _draw(len(sums), draws, seed)
    total, count = times_drawn @ sums, times_drawn @ counts
    count = np.broadcast_to(count, total.shape)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


@lru_cache(maxsize=4)
def _draw(groups: int, draws: int, seed: int) -> NDArray[np.float64]:
    """How often each group is drawn: (draw, group)."""
    chances = np.full(groups, 1 / groups)
    return np.random.default_rng(seed).multinomial(groups, chances, draws).astype(np.float64)


def with_unit(name: str, unit: str) -> str:
    """A name and, where it has one, its unit in brackets."""
    return f"{name} [{unit}]" if unit else name
