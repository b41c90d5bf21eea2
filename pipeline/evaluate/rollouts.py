"""Rollouts: a policy runs the simulated insertion closed loop, many environments side by side.

Success, its limits and reasons are the environment's (`pipeline.simulation.insertion`); rates have
Wilson intervals. The same seeds give the same figures, bit for bit on one machine.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import binomtest
from tqdm import tqdm

from pipeline.base.config import RolloutParams
from pipeline.base.errors import CheckpointMismatch
from pipeline.base.table import Table
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.normalization import Normalization
from pipeline.policy.policy import Policy
from pipeline.robot.chunking import check_chunking
from pipeline.robot.features import LiveFeatures
from pipeline.robot.guides import stack_guides
from pipeline.robot.loop import ControlLoop, LoopTiming, SafeStop
from pipeline.robot.memory import SeenFeatures
from pipeline.simulation.arm import ActionRotation
from pipeline.simulation.environment import InsertionEnvironment
from pipeline.simulation.insertion import INSERTED, TICK_HZ, EpisodeTrace, NeedleInsertion
from pipeline.simulation.insertion_formats import INSTRUCTION
from pipeline.simulation.rendering import VIEWS, photograph

POLICY: Final = "policy"
EXPERT: Final = "expert"
SIDE_BY_SIDE: Final = 50
"""Environments that share a pass of the model."""
_USUAL_AGE_S = 0.15
"""Of features, where there are none."""


@dataclass(frozen=True)
class RolloutEpisode:
    """One episode, and how it ended.

    `lateral_mm` sideways from the target where the tissue was punctured, else at the end;
    `depth_mm` from the tip to the layer at the end, positive short of it; `overshoot_mm` the
    farthest beyond it.
    """

    controller: str
    """`POLICY`, `EXPERT` (the demonstrator), or the policy with a stream off."""
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
    trace: EpisodeTrace
    frames: Callable[[float], Mapping[str, NDArray[np.uint8]]]
    """What the cameras saw at a time in s: RGB (126, 224, 3) by view."""


@dataclass(frozen=True)
class SuccessRate:
    """A share of episodes with its 95 % interval after Wilson (1927)."""

    rate: float
    low: float
    high: float
    episodes: int

    @classmethod
    def of(cls, episodes: Sequence[RolloutEpisode]) -> "SuccessRate":
        """That of these episodes, at least one."""
        successes = sum(episode.success for episode in episodes)
        interval = binomtest(successes, len(episodes)).proportion_ci(method="wilson")
        rate = successes / len(episodes)
        return cls(rate, float(interval.low), float(interval.high), len(episodes))

    def __str__(self) -> str:
        return f"{self.rate:.0%} ({self.low:.0%} to {self.high:.0%})"


@dataclass(frozen=True)
class Rollouts:
    """All episodes of a rollout, and how it was run."""

    checkpoint: str
    level: str
    settings: Mapping[str, Any]
    episodes: tuple[RolloutEpisode, ...]

    @property
    def controllers(self) -> tuple[str, ...]:
        """Who controlled them, the policy first."""
        return tuple(dict.fromkeys(episode.controller for episode in self.episodes))

    def of(self, controller: str) -> tuple[RolloutEpisode, ...]:
        """The episodes of one controller."""
        return tuple(e for e in self.episodes if e.controller == controller)

    def rates(self) -> dict[str, SuccessRate]:
        """The success of each controller."""
        return {name: SuccessRate.of(self.of(name)) for name in self.controllers}

    def summary(self) -> Table:
        """A row a controller: its success, and where its episodes ended."""
        rows: list[tuple[Any, ...]] = []
        for name, rate in self.rates().items():
            episodes = self.of(name)
            lateral = float(np.median([episode.lateral_mm for episode in episodes]))
            time = float(np.median([episode.time_s for episode in episodes]))
            failed = Counter(e.reason for e in episodes if not e.success).most_common()
            reasons = ", ".join(f"{count} {reason}" for reason, count in failed)
            rows.append((name, str(rate), len(episodes), lateral, time, reasons))
        heads = ("controller", "success (95 % interval)", "episodes", "median lateral miss [mm]",
                 "median time [s]", "failed by")  # fmt: skip
        return Table(heads, rows, f"Success at level {self.level}")

    def document(self) -> dict[str, Any]:
        """The content of metrics.json."""
        success = {name: vars(rate) for name, rate in self.rates().items()}
        return {
            "success": success,
            "levels": {self.level: success},
            "checkpoint": self.checkpoint,
            "settings": dict(self.settings),
        }

    def table(self) -> Table:
        """The content of episodes.csv."""
        return Table(
            ("controller", *_COLUMNS),
            [(e.controller, *(getattr(e, name) for name in _COLUMNS)) for e in self.episodes],
        )


_COLUMNS: Final = (
    "seed", "level", "success", "reason", "lateral_mm", "depth_mm", "overshoot_mm", "max_force_n",
    "time_s", "ticks",
)  # fmt: skip


@dataclass(frozen=True)
class LivePart:
    """What a rollout runs: the policy, its model where it uses features, and how it was trained."""

    policy: Policy
    features: LiveFeatures | None
    reuse: int
    normalization: Normalization


def roll_out(
    checkpoint: PolicyCheckpoint,
    name: str,
    live: LivePart,
    wanted: RolloutParams,
    progress: bool = False,
) -> Rollouts:
    """Episodes of the policy, the demonstrator and the policy with each stream off.

    Raises `CheckpointMismatch` where the phantom has not what the policy was trained on, and
    `ConfigError` for chunking that its expert cannot do.
    """
    refuse_other_robot(checkpoint)
    check_chunking(wanted.chunking, live.policy.stochastic)
    encoders = tuple(live.policy.encoders)
    off = [stream for stream in ("sensor", "features") if stream in encoders and len(encoders) > 1]
    switched = off if wanted.ablations else []
    seeds = range(wanted.seed, wanted.seed + wanted.episodes)
    groups = [seeds[at : at + SIDE_BY_SIDE] for at in range(0, len(seeds), SIDE_BY_SIDE)]
    rotation = action_rotation(checkpoint)
    episodes: list[RolloutEpisode] = []
    with tqdm(
        total=(2 + len(switched)) * len(seeds), unit="episode", disable=None if progress else True
    ) as bar:
        for stream in (None, *switched):
            label = f"{stream} off" if stream else POLICY
            bar.set_description(label)
            for group in groups:
                robots = [_begin(wanted, rotation, seed) for seed in group]
                reasons = _drive(robots, live, wanted, group[0], stream, bar.update)
                episodes += [
                    _episode(label, wanted.level, seed, robot.insertion, reason)
                    for seed, robot, reason in zip(group, robots, reasons, strict=True)
                ]
        bar.set_description(EXPERT)
        for seed in seeds:
            insertion = _begin(wanted, rotation, seed).insertion
            while not insertion.finished:
                insertion.step(insertion.expert_action())
            episodes.append(_episode(EXPERT, wanted.level, seed, insertion, None))
            bar.update()
    settings = wanted.model_dump(mode="json", exclude={"checkpoint", "output", "device"})
    return Rollouts(name, wanted.level, settings, tuple(episodes))


def refuse_other_robot(checkpoint: PolicyCheckpoint) -> None:
    """Raise `CheckpointMismatch` where the phantom has not what a policy was trained on."""
    streams, shape = checkpoint.source["streams"], checkpoint.shape
    views = streams["views"]
    has = {
        "views": (set(views) <= set(VIEWS), views, VIEWS),
        "action kind": (streams["action"]["kind"] == "delta", streams["action"]["kind"], "delta"),
        "action channels": (shape.action_dim == 7, shape.action_dim, 7),
        "state channels": (shape.state_dim in (0, 12), shape.state_dim, 12),
        "sensor channels": (shape.sensor_channels in (0, 1026), shape.sensor_channels, 1026),
        "action_hz": (
            checkpoint.source["action_hz"] == TICK_HZ,
            checkpoint.source["action_hz"],
            TICK_HZ,
        ),
    }
    if differs := [
        f"{name} {got} (phantom: {own})" for name, (same, got, own) in has.items() if not same
    ]:
        raise CheckpointMismatch(
            "rollout.environment: the policy was trained on another robot than the phantom: "
            f"{'; '.join(differs)}. Roll out a policy of recordings of the phantom "
            "(python -m stages.demo)."
        )


def action_rotation(checkpoint: PolicyCheckpoint) -> ActionRotation:
    """The convention of the policy's rotation channels, by their names."""
    names = checkpoint.source["streams"]["action"]["names"]
    return "rotvec" if "rx" in names else "euler_delta"


def _begin(wanted: RolloutParams, rotation: ActionRotation, seed: int) -> InsertionEnvironment:
    robot = InsertionEnvironment(wanted.level, rotation, cameras=False)
    robot.reset(seed=seed)
    return robot


def _drive(
    robots: Sequence[InsertionEnvironment],
    live: LivePart,
    wanted: RolloutParams,
    seed: int,
    off: str | None,
    ended: Callable[[], Any],
) -> list[str | None]:
    """Run the policy on all robots at once to their ends; a safe stop's reason for each, or None.

    `off` names a stream that tells the policy nothing. `ended` is called for each that ends.
    """
    policy, needs = live.policy, "features" in live.policy.encoders and off != "features"
    timing = LoopTiming(live.reuse, wanted.latency_ms / 1000, wanted.execute, wanted.chunking)
    loops = [ControlLoop(policy.params, policy.shape, timing, needs) for _ in robots]
    generator = torch.Generator().manual_seed(seed)
    stops: list[str | None] = [None] * len(robots)
    for loop, robot in zip(loops, robots, strict=True):
        loop.sense(robot.readings())
    active = list(range(len(robots)))
    while active:
        _look([(robots[i], loops[i]) for i in active if loops[i].frames_due], live.features)
        due = [i for i in active if loops[i].chunk_due]
        chunks = _chunks(live, [loops[i] for i in due], off, generator)
        for i, chunk in zip(due, chunks, strict=True):
            try:
                loops[i].plan(chunk)
            except SafeStop as stop:
                stops[i] = f"safe stop: {stop}"
        for i in active:
            if stops[i] is None:
                loops[i].sense(robots[i].step(loops[i].action())[0])
        going = [i for i in active if stops[i] is None and not robots[i].insertion.finished]
        for _ in range(len(active) - len(going)):
            ended()
        active = going
    return stops


def _look(
    due: Sequence[tuple[InsertionEnvironment, ControlLoop]], features: LiveFeatures | None
) -> None:
    """One pass of the model for all whose frames are due."""
    if not due or features is None:
        return
    taken = [robot.frames() for robot, _ in due]
    seen, valid = features(
        [{view: frame for view, (_, frame) in views.items()} for views in taken], INSTRUCTION
    )
    for (_, loop), views, row, slots in zip(due, taken, seen.numpy(), valid.numpy(), strict=True):
        newest = max(time for time, _ in views.values())
        loop.see(SeenFeatures(row, slots, newest))


def _chunks(
    live: LivePart, loops: Sequence[ControlLoop], off: str | None, generator: torch.Generator
) -> NDArray[np.float32]:
    """The head's chunks (loop, horizon, action) for robots that ask for one."""
    if not loops:
        return np.zeros((0, 0, 0), np.float32)
    guides = [loop.executor.begin() for loop in loops]
    fields = [loop.memory.observation() for loop in loops]
    streams = {name: np.stack([each[name] for each in fields]) for name in fields[0]}
    if off is not None:
        streams |= _at_mean(live, off, len(loops))
    observation = live.policy.observe(streams)
    guide = stack_guides(guides, observation.features.device)
    return live.policy.act(observation, generator, guide).cpu().numpy()


def _at_mean(live: LivePart, stream: str, batch: int) -> dict[str, NDArray[Any]]:
    """A stream that says nothing: every value at its training mean, as in an evaluation."""
    statistics = getattr(live.normalization, stream)
    assert statistics is not None, stream
    mean = statistics.mean.astype(np.float32)
    if stream == "features":
        real: NDArray[Any] = np.ones((batch, len(mean)), np.bool_)
        age = np.full(batch, _USUAL_AGE_S, np.float32)
        values = np.broadcast_to(mean, (batch, *mean.shape))
        return {"features": values.copy(), "slot_valid": real, "feature_age": age}
    window = live.policy.params.sensor_window
    values = np.broadcast_to(mean, (batch, window, *mean.shape))
    return {stream: values.copy(), f"{stream}_valid": np.full(batch, window)}


def _episode(
    controller: str, level: str, seed: int, insertion: NeedleInsertion, stop: str | None
) -> RolloutEpisode:
    """What is told of an episode that has ended, by its outcome or by a safe stop."""
    progress, trace = insertion.progress, insertion.trace()
    reason = stop or str(insertion.outcome)
    return RolloutEpisode(
        controller=controller,
        seed=seed,
        level=level,
        success=reason == INSERTED,
        reason=reason,
        lateral_mm=float(np.hypot(*trace.lateral_mm)),
        depth_mm=float(trace.layer_mm[-1]),
        overshoot_mm=progress.overshoot_mm,
        max_force_n=progress.max_force_n,
        time_s=insertion.time_s,
        ticks=len(trace.time_s),
        trace=trace,
        frames=lambda time_s: {view: photograph(view, insertion, time_s) for view in VIEWS},
    )
