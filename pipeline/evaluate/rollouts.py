"""The results of rollouts: episodes of the simulated insertion, success rates and tables.

The environment (`pipeline.simulation.insertion`) defines success, its limits and the reasons of
failure. Rates have Wilson intervals.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from pipeline.base.config import latencies_ms
from pipeline.base.text import Table
from pipeline.simulation.insertion import InsertionTrace

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
    """One episode, and how it ended.

    `lateral_mm` is the distance sideways from the target where the tissue was punctured, else at
    the end. `depth_mm` is the distance from the tip to the layer at the end, positive if the tip is
    short of it. `overshoot_mm` is the greatest distance beyond the layer.
    """

    controller: str
    """`POLICY`, `EXPERT` (the demonstrator), or the ablation that the policy ran under."""
    seed: int
    level: str
    success: bool
    reason: str
    lateral_mm: float
    depth_mm: float
    overshoot_mm: float
    max_force_n: float
    time_s: float
    ticks: int
    trace: InsertionTrace
    frames: Callable[[float], Mapping[str, NDArray[np.uint8]]]
    """The camera frames at a time in s: RGB (126, 224, 3) by view."""


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


@dataclass(frozen=True)
class Rollouts:
    """All episodes of a rollout, and how it was run."""

    checkpoint: str
    settings: Mapping[str, Any]
    episodes: tuple[RolloutEpisode, ...]

    @property
    def level(self) -> str:
        """The level of all episodes."""
        return self.episodes[0].level

    @property
    def controllers(self) -> tuple[str, ...]:
        """The controllers of the episodes, the policy first."""
        return tuple(dict.fromkeys(episode.controller for episode in self.episodes))

    def of(self, controller: str) -> tuple[RolloutEpisode, ...]:
        """The episodes of one controller."""
        return tuple(e for e in self.episodes if e.controller == controller)

    def rates(self) -> dict[str, SuccessRate]:
        """The success of each controller."""
        return {
            name: SuccessRate.of([e.success for e in self.of(name)]) for name in self.controllers
        }

    def by_latency(self) -> dict[float, SuccessRate]:
        """The policy's success by the latency of the model in ms, in rising order."""
        rates, (first, *others) = self.rates(), latencies_ms(self.settings["latency_ms"])
        names = {first: POLICY} | {latency_ms: late_name(latency_ms) for latency_ms in others}
        return {latency_ms: rates[names[latency_ms]] for latency_ms in sorted(names)}

    def summary(self) -> Table:
        """A row for each controller: its success, and where and why its episodes ended."""
        rows: list[tuple[Any, ...]] = []
        for name, rate in self.rates().items():
            episodes = self.of(name)
            lateral = float(np.median([episode.lateral_mm for episode in episodes]))
            times = [episode.time_s for episode in episodes if episode.success]
            failed = Counter(e.reason for e in episodes if not e.success).most_common()
            reasons = ", ".join(f"{count} {reason}" for reason, count in failed)
            rows.append(
                (controller_name(name), str(rate), len(episodes), lateral,
                 float(np.median(times)) if times else None, reasons)
            )  # fmt: skip
        heads = ("controller", "success (95 % interval)", "episodes", "median lateral miss [mm]",
                 "median time to success [s]", "failed by")  # fmt: skip
        return Table(heads, rows, f"Success at level {self.level}")

    def document(self) -> dict[str, Any]:
        """The content of metrics.json."""
        success = {name: vars(rate) for name, rate in self.rates().items()}
        late = {f"{latency_ms:g}": vars(rate) for latency_ms, rate in self.by_latency().items()}
        return {"success": success, "levels": {self.level: success}, "latency_ms": late}

    def table(self, policy: bool) -> Table:
        """A row for each episode: of the policy, or of the others with their controller."""
        heads = _COLUMNS if policy else ("controller", *_COLUMNS)
        episodes = [e for e in self.episodes if (e.controller == POLICY) == policy]
        return Table(heads, [tuple(getattr(e, name) for name in heads) for e in episodes])


_COLUMNS: Final = (
    "seed", "level", "success", "reason", "lateral_mm", "depth_mm", "overshoot_mm", "max_force_n",
    "time_s", "ticks",
)  # fmt: skip
