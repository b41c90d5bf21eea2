"""Figures with their 95 % intervals: errors, differences and ratios, by one bootstrap over groups.

All draw the same groups, so that whatever is compared is compared on the same draws.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.evaluate.baselines import BASELINES
from pipeline.evaluate.intervals import FEWEST_GROUPS, bootstrap_means, interval
from pipeline.train.scores import ActionGroup, Comparison, Errors, summed

Draws = NDArray[np.float64]
NO_INTERVAL = "intervals take at least two groups of test recordings"


@dataclass(frozen=True)
class Figure:
    """A number and its 95 % interval, None where there is none."""

    value: float
    low: float | None = None
    high: float | None = None

    @classmethod
    def of(cls, value: float, draws: Draws | None) -> "Figure":
        """With the interval of its draws (draw,)."""
        if draws is None or np.isnan(draws).all():
            return cls(value)
        low, high = interval(draws)
        return cls(value, float(low), float(high))

    def text(self, sign: str = "") -> str:
        """As `0.279 (0.251–0.304)`, all in as many decimals as give the largest three digits.

        With a `sign` of `+`, as `-0.02 (-0.05 to +0.01)`.
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
        """Of a difference: whether its interval leaves 0 out; None without one."""
        return None if self.low is None or self.high is None else not self.low <= 0 <= self.high

    @property
    def verdict(self) -> str:
        """`resolved` in a word or two; empty without an interval."""
        return {None: "", True: "resolved", False: "not resolved"}[self.resolved]

    def columns(self, name: str) -> dict[str, float | None]:
        """As columns of a table."""
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


@dataclass(frozen=True)
class Rivalry:
    """The policy beside the baseline that is best at this very figure."""

    policy: Figure
    best: str
    baseline: Figure
    difference: Figure
    """The policy's error less the baseline's, by the paired bootstrap."""

    @property
    def ratio(self) -> float | None:
        """The policy's error divided by the baseline's; None where that is right by itself."""
        return self.policy.value / self.baseline.value if self.baseline.value > 0 else None

    @property
    def verdict(self) -> str:
        """`better`, `worse` or `not resolved`; without an interval, that there is none."""
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
    """The sums whose ratio is `Comparison.error`, and the entries they are over: (group,)."""
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

    By the paired bootstrap. None where the latter is 0.
    """
    (sums, _), (others, _) = (sums_by_group(which, "policy") for which in (over, under))
    if not others.any():
        return None
    return Figure.of(float(sums.sum() / others.sum()), draws(sums, others))


def mean_over_ticks(values: NDArray[np.floating], groups: NDArray[np.str_]) -> Figure:
    """The mean of (tick,) `values` whose ticks are of these `groups`."""
    _, place, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return Figure.of(float(values.mean()), draws(summed(values, place), counts))


def draws(sums: Errors, counts: NDArray[np.number]) -> Draws | None:
    """Ratios (draw,) of sums over groups, both (group,); None of too few groups."""
    if len(sums) < FEWEST_GROUPS:
        return None
    return bootstrap_means(sums[:, None], counts[:, None].astype(np.float64))[:, 0]
