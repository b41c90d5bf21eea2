"""The results of rollouts: episodes, success rates and tables.

The environment defines success and the reasons of failure. Rates have Wilson intervals.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from pipeline.base.config import latencies_ms
from pipeline.base.text import Table
from pipeline.simulation.insertion import InsertionTrace
from pipeline.simulation.interface import Shots

POLICY: Final = "policy"
EXPERT: Final = "expert"


def late_name(latency_ms: float) -> str:
    """The name of the policy as a controller, when its model has this latency."""
    return f"{latency_ms:g} ms late"


def controller_name(controller: str) -> str:
    """The name of a controller in reports."""
    known = {POLICY: "policy", EXPERT: "demonstrator"}
    return known.get(controller, f"policy, {controller}")


@dataclass(frozen=True)
class RolloutEpisode:
    """One episode, and how it ended."""

    controller: str
    """`POLICY`, `EXPERT` (the demonstrator), or the ablation that the policy ran under."""
    seed: int
    level: str
    """Of the phantom; of another environment its task."""
    success: bool
    reason: str
    figures: Mapping[str, float]
    """What the environment says of the episode, by names with units."""
    time_s: float
    ticks: int
    frames: Callable[[Sequence[int]], list[Shots]]
    """Plays the episode again, and gives the frames that were newest after so many actions."""
    actions: int
    trace: InsertionTrace | None = None
    """The course of an insertion; None in other environments."""


@dataclass(frozen=True)
class SuccessRate:
    """A share of episodes with its 95 % interval after Wilson (1927)."""

    rate: float
    low: float
    high: float
    episodes: int

    @classmethod
    def of(cls, successes: Sequence[bool]) -> "SuccessRate":
        """The rate of one or more episodes, from whether each succeeded."""
        count, episodes = sum(successes), len(successes)
        interval = binomtest(count, episodes).proportion_ci(method="wilson")
        return cls(count / episodes, float(interval.low), float(interval.high), episodes)

    def __str__(self) -> str:
        return f"{self.rate:.0%} ({self.low:.0%} to {self.high:.0%})"


def error_bars(
    rates: Iterable[SuccessRate],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rates in percent (rate,), and how far their intervals reach down and up (2, rate)."""
    centre, low, high = 100 * np.array([(r.rate, r.low, r.high) for r in rates]).T
    return centre, np.maximum([centre - low, high - centre], 0)


@dataclass(frozen=True)
class Rollouts:
    """All episodes of a rollout, and how it was run."""

    checkpoint: str
    settings: Mapping[str, Any]
    episodes: tuple[RolloutEpisode, ...]

    @property
    def levels(self) -> tuple[str, ...]:
        """The levels of the episodes, each once."""
        return tuple(dict.fromkeys(episode.level for episode in self.episodes))

    @property
    def controllers(self) -> tuple[str, ...]:
        """The controllers of the episodes, the policy first."""
        return tuple(dict.fromkeys(episode.controller for episode in self.episodes))

    def of(self, controller: str, level: str | None = None) -> tuple[RolloutEpisode, ...]:
        """The episodes of one controller, at one level or, with None, at all."""
        own = (e for e in self.episodes if e.controller == controller)
        return tuple(e for e in own if level in (None, e.level))

    def rates(self, level: str | None = None) -> dict[str, SuccessRate]:
        """The success of each controller at a level, or at all."""
        episodes = {name: self.of(name, level) for name in self.controllers}
        return {
            name: SuccessRate.of([e.success for e in own]) for name, own in episodes.items() if own
        }

    def by_latency(self) -> dict[float, SuccessRate]:
        """The policy's success by the latency of the model in ms, in rising order."""
        rates, (first, *others) = self.rates(), latencies_ms(self.settings["latency_ms"])
        names = {first: POLICY} | {latency_ms: late_name(latency_ms) for latency_ms in others}
        return {latency_ms: rates[names[latency_ms]] for latency_ms in sorted(names)}

    def summary(self) -> Table:
        """A row for each controller and level: its success, and where and why its episodes ended.

        Of the figures that the environment gives, the first is shown.
        """
        rows: list[tuple[Any, ...]] = []
        figure = next(iter(self.episodes[0].figures), None)
        several = len(self.levels) > 1
        for level in self.levels:
            for name, rate in self.rates(level).items():
                episodes = self.of(name, level)
                times = [episode.time_s for episode in episodes if episode.success]
                failed = Counter(e.reason for e in episodes if not e.success).most_common()
                reasons = ", ".join(f"{count} {reason}" for reason, count in failed)
                row = [controller_name(name), str(rate), len(episodes)]
                row += [level] if several else []
                row += [_median([e.figures[figure] for e in episodes])] if figure else []
                rows.append((*row, _median(times), reasons))
        heads = ["controller", "success (95 % interval)", "episodes"]
        heads += ["level"] if several else []
        heads += [f"median {_spelled(figure)}"] if figure else []
        title = "Success" if several else f"Success at level {self.levels[0]}"
        return Table((*heads, "median time to success [s]", "failed by"), rows, title)

    def document(self) -> dict[str, Any]:
        """The content of metrics.json."""
        success = {name: vars(rate) for name, rate in self.rates().items()}
        levels = {
            level: {name: vars(rate) for name, rate in self.rates(level).items()}
            for level in self.levels
        }
        late = {f"{latency_ms:g}": vars(rate) for latency_ms, rate in self.by_latency().items()}
        return {"success": success, "levels": levels, "latency_ms": late}

    def table(self, policy: bool) -> Table:
        """A row for each episode: of the policy, or of the others with their controller."""
        figures = tuple(dict.fromkeys(key for e in self.episodes for key in e.figures))
        own = ("seed", "level", "success", "reason", *figures, "time_s", "ticks")
        heads = own if policy else ("controller", *own)
        episodes = [e for e in self.episodes if (e.controller == POLICY) == policy]
        rows = [tuple({**vars(e), **e.figures}.get(name) for name in heads) for e in episodes]
        return Table(heads, rows)


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _spelled(figure: str) -> str:
    """`lateral_mm` gives `lateral [mm]`."""
    name, _, unit = figure.rpartition("_")
    return f"{name.replace('_', ' ')} [{unit}]"
