"""Rollouts: a policy runs the simulated insertion closed loop, many environments side by side.

Success, its limits and reasons are the environment's (`pipeline.simulation.insertion`); rates have
Wilson intervals. The same seeds give the same figures, bit for bit on one machine.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import binomtest
from tqdm import tqdm

from pipeline.base.commands import command
from pipeline.base.config import Level, RolloutAblation, RolloutParams
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.base.table import Table
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.observation import moving_channels, stream_of
from pipeline.policy.policy import Policy
from pipeline.robot.chunking import Executor, check_chunking
from pipeline.robot.live_features import LiveFeatures, prove
from pipeline.robot.loop import ControlLoop, SafeStop
from pipeline.robot.robot_memory import RobotMemory, SeenFeatures
from pipeline.robot.session import stack_guides
from pipeline.simulation.environment import InsertionEnvironment
from pipeline.simulation.insertion import INSERTED, TICK_HZ, InsertionTrace, NeedleInsertion
from pipeline.simulation.insertion_formats import INSTRUCTION
from pipeline.simulation.rendering import VIEWS, photograph

POLICY: Final = "policy"
EXPERT: Final = "expert"
SIDE_BY_SIDE: Final = 50
"""Environments that are stepped together, and share passes of the model."""


def controller_name(controller: str) -> str:
    """What people read of a controller."""
    known = {POLICY: "policy", EXPERT: "demonstrator"}
    return known.get(controller, f"policy, {controller}")


@dataclass(frozen=True)
class RolloutEpisode:
    """One episode, and how it ended.

    `lateral_mm` sideways from the target where the tissue was punctured, else at the end;
    `depth_mm` from the tip to the layer at the end, positive short of it; `overshoot_mm` the
    farthest beyond it.
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
    """What the cameras saw at a time in s: RGB (126, 224, 3) by view."""


@dataclass(frozen=True)
class SuccessRate:
    """A share of episodes with its 95 % interval after Wilson (1927)."""

    rate: float
    low: float
    high: float
    episodes: int

    @classmethod
    def of(cls, successes: Sequence[bool]) -> "SuccessRate":
        """That of episodes, at least one, by whether each succeeded."""
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
        """That of all episodes."""
        return self.episodes[0].level

    @property
    def controllers(self) -> tuple[str, ...]:
        """Who controlled them, the policy first."""
        return tuple(dict.fromkeys(episode.controller for episode in self.episodes))

    def of(self, controller: str) -> tuple[RolloutEpisode, ...]:
        """The episodes of one controller."""
        return tuple(e for e in self.episodes if e.controller == controller)

    def rates(self) -> dict[str, SuccessRate]:
        """The success of each controller."""
        return {
            name: SuccessRate.of([e.success for e in self.of(name)]) for name in self.controllers
        }

    def summary(self) -> Table:
        """A row a controller: its success, and where its episodes ended."""
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
        return {"success": success, "levels": {self.level: success}}

    def table(self, policy: bool) -> Table:
        """A row an episode: those of the policy, or those beside it with who controlled them."""
        heads = _COLUMNS if policy else ("controller", *_COLUMNS)
        episodes = [e for e in self.episodes if (e.controller == POLICY) == policy]
        return Table(heads, [tuple(getattr(e, name) for name in heads) for e in episodes])


_COLUMNS: Final = (
    "seed", "level", "success", "reason", "lateral_mm", "depth_mm", "overshoot_mm", "max_force_n",
    "time_s", "ticks",
)  # fmt: skip


def roll_out(
    checkpoint: PolicyCheckpoint,
    name: str,
    policy: Policy,
    load_features: Callable[[], LiveFeatures],
    wanted: RolloutParams,
    say: Callable[[str], None] = lambda line: None,
) -> Rollouts:
    """Episodes of the policy, of it with a stream off, and of the demonstrator.

    `say` is told of each controller whose episodes have ended.

    `load_features` is called where the policy looks at features, once all that can be refused
    without it is known to be good. Raises `CheckpointMismatch` where the phantom has not what the
    policy was trained on, `ConfigError` for an instruction that it was not, for chunking that its
    expert cannot do and for more steps than a chunk has. Before the first episode the model proves
    that it gives the policy's features, as `prove` does.
    """
    shape = checkpoint.shape
    widths = {"action": shape.action_dim, "state": shape.state_dim, "sensor": shape.sensor_channels}
    refuse_other_robot(checkpoint.source, widths)
    check_chunking(wanted.chunking, policy.stochastic)
    Executor(wanted.chunking, wanted.execute, policy.params.horizon)
    features = load_features() if "features" in policy.encoders else None
    if features is not None:
        prove(checkpoint, features, say)
    instruction = instruction_of(checkpoint.instructions)
    drive = _Driver(checkpoint, policy, features, wanted, instruction).drive
    alone = len(policy.encoders) == 1
    ablations: list[RolloutAblation] = [
        name
        for name in dict.fromkeys(wanted.ablations)
        if name.split()[0] in policy.encoders and not (alone and name.endswith("off"))
    ]
    settings = {"checkpoint": name, "step": checkpoint.step}
    settings |= {"model_type": policy.params.model_type, "instruction": instruction}
    return run_episodes(drive, checkpoint.source, [None, *ablations], wanted, settings, say)


Drive = Callable[
    [Sequence[InsertionEnvironment], RolloutAblation | None, Callable[[], Any]], list[str | None]
]
"""Runs a policy on these robots to their ends; why each stopped safely, or None.

The policy is under an ablation, None for none; the last is called for each robot that ends.
"""


def run_episodes(
    drive: Drive,
    source: Mapping[str, Any],
    ablations: Sequence[RolloutAblation | None],
    wanted: RolloutParams,
    settings: Mapping[str, Any],
    say: Callable[[str], None],
) -> Rollouts:
    """Episodes of the policy under each of `ablations`, None for none, and of the demonstrator.

    `source` is what the policy was trained on, `settings` tell of it, its `checkpoint` among them.
    """
    seeds = range(wanted.seed, wanted.seed + wanted.episodes)
    groups = [seeds[at : at + SIDE_BY_SIDE] for at in range(0, len(seeds), SIDE_BY_SIDE)]
    episodes: list[RolloutEpisode] = []
    total = (1 + len(ablations)) * len(seeds)
    with tqdm(total=total, unit="episode", disable=None) as bar:
        for ablation in ablations:
            controller = ablation or POLICY
            bar.set_description(controller)
            for group in groups:
                robots = [_begin_episode(source, wanted.level, seed) for seed in group]
                stops = drive(robots, ablation, bar.update)
                episodes += [
                    _episode(controller, wanted.level, robot.insertion, stop)
                    for robot, stop in zip(robots, stops, strict=True)
                ]
            rate = SuccessRate.of([e.success for e in episodes if e.controller == controller])
            say(f"{controller_name(controller)}: {rate} of {rate.episodes} episodes")
        bar.set_description(EXPERT)
        for seed in seeds:
            insertion = _begin_episode(source, wanted.level, seed).insertion
            while not insertion.finished:
                insertion.step(insertion.expert_action())
            episodes.append(_episode(EXPERT, wanted.level, insertion, None))
            bar.update()
    told = wanted.model_dump(mode="json", exclude={"checkpoint", "output", "device"})
    return Rollouts(settings["checkpoint"], told | dict(settings), tuple(episodes))


def _begin_episode(source: Mapping[str, Any], level: Level, seed: int) -> InsertionEnvironment:
    """The phantom at the beginning of an episode, with actions as a policy's `source` has them."""
    rotation = "rotvec" if "rx" in source["streams"]["action"]["names"] else "euler_delta"
    robot = InsertionEnvironment(level, rotation, cameras=False)
    robot.reset(seed=seed)
    return robot


def refuse_other_robot(source: Mapping[str, Any], widths: Mapping[str, int]) -> None:
    """Raise `CheckpointMismatch` where the phantom has not what a policy was trained on.

    `source` has `streams` and `action_hz`; `widths` are those of action, state and sensor, 0 of a
    stream that the policy does not look at.
    """
    streams, hz = source["streams"], source["action_hz"]
    kind, own = streams["action"]["kind"], {"action": (7,), "state": (0, 12), "sensor": (0, 1026)}
    fits = all(widths[name] in known for name, known in own.items())
    if not (fits and kind == "delta" and hz == TICK_HZ and set(streams["views"]) <= set(VIEWS)):
        channels = ", ".join(f"{name} channels {width}" for name, width in widths.items())
        raise CheckpointMismatch(
            "rollout.environment: the policy was trained on another robot than the phantom: views "
            f"{', '.join(streams['views'])}, action {kind}, {channels}, action_hz {hz}, of the "
            f"phantom views {', '.join(VIEWS)}, action delta, action channels 7, state channels "
            f"12, sensor channels 1026, action_hz {TICK_HZ}. Judge it on its own recordings "
            f"({command('evaluate')}) and set rollout.environment to null, which leaves "
            "rollouts out of dvc repro."
        )


def instruction_of(trained: Sequence[str]) -> str:
    """What the robot is told: the phantom's task, or else the only words the policy was trained on.

    Raises `ConfigError` where it was trained on several others.
    """
    if not trained or INSTRUCTION in trained:
        return INSTRUCTION
    if len(trained) == 1:
        return trained[0]
    raise ConfigError(
        f"rollout: the policy was trained on other instructions than {INSTRUCTION!r}: "
        f"{', '.join(map(repr, trained))}. Train it on the phantom's, or on one: "
        "data.sources[].instruction"
    )


@dataclass
class _Robot:
    """One environment with its loop, and what is remembered of it."""

    environment: InsertionEnvironment
    loop: ControlLoop
    memory: RobotMemory
    generator: torch.Generator
    under_way: tuple[float, SeenFeatures] | None = None
    """When the pass of the model ends that has begun, and what it gives."""
    first: dict[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    """What a frozen stream was first."""

    def sense(self, readings: Mapping[str, NDArray[Any]]) -> None:
        """Begin a tick; features whose pass has ended by now become the newest."""
        self.loop.begin_tick()
        self.memory.sense(readings)
        self._take_features()

    def see(self, seen: SeenFeatures, latency_s: float) -> None:
        """The answer of a pass that begins now; it is ready `latency_s` from now."""
        self.loop.pass_began()
        self.under_way = self.memory.time_s + latency_s, seen
        self._take_features()

    def _take_features(self) -> None:
        if self.under_way is not None and self.memory.time_s >= self.under_way[0] - 1e-9:
            self.memory.features, self.under_way = self.under_way[1], None
            self.loop.pass_ended()


@dataclass(frozen=True)
class _Driver:
    """Drives a policy's robots; `features` is the model that it asks, None where it asks none."""

    checkpoint: PolicyCheckpoint
    policy: Policy
    features: LiveFeatures | None
    wanted: RolloutParams
    instruction: str

    def drive(
        self,
        environments: Sequence[InsertionEnvironment],
        ablation: RolloutAblation | None,
        ended: Callable[[], Any],
    ) -> list[str | None]:
        """`Drive` of all robots at once.

        A robot draws from a generator of its own seed, so that it does as it would alone.
        """
        robots = [self._robot(environment) for environment in environments]
        stops: list[str | None] = [None] * len(robots)
        for robot in robots:
            robot.sense(robot.environment.readings())
        active = list(range(len(robots)))
        still = np.zeros(self.policy.shape.action_dim)
        while active:
            self._look([robots[i] for i in active if robots[i].loop.frames_due])
            due = [i for i in active if self._sees(robots[i]) and robots[i].loop.chunk_due]
            chunks = self._chunks([robots[i] for i in due], ablation) if due else ()
            for i, chunk in zip(due, chunks, strict=True):
                try:
                    robots[i].loop.plan(chunk)
                except SafeStop as stop:
                    stops[i] = f"safe stop: {stop}"
            for i in active:
                if stops[i] is None:
                    action = robots[i].loop.action()
                    doing = still if action is None else action
                    robots[i].sense(robots[i].environment.step(doing)[0])
            going = [
                i for i in active if stops[i] is None and not environments[i].insertion.finished
            ]
            for _ in range(len(active) - len(going)):
                ended()
            active = going
        return stops

    def _robot(self, environment: InsertionEnvironment) -> _Robot:
        """The loop and the memory of a robot whose episode begins."""
        params, wanted = self.policy.params, self.wanted
        source = self.checkpoint.source
        moving = moving_channels(source["streams"]["action"])
        executor = Executor(wanted.chunking, wanted.execute, params.horizon, moving)
        memory = RobotMemory.of(self.policy)
        loop = ControlLoop(executor, source["vlm_reuse_count"], self.features is not None)
        drawn = torch.Generator().manual_seed(environment.insertion.layout.seed)
        return _Robot(environment, loop, memory, drawn)

    def _sees(self, robot: _Robot) -> bool:
        """Whether the head can be asked: the first features are there, or it looks at none."""
        return self.features is None or robot.memory.features is not None

    def _look(self, due: Sequence[_Robot]) -> None:
        """Begin a pass of the model for all whose frames are due."""
        if not due or self.features is None:
            return
        trained = self.checkpoint.source["streams"]["views"]
        shots = [robot.environment.frames() for robot in due]
        taken = [{view: views[view] for view in trained} for views in shots]
        frames = [{view: frame for view, (_, frame) in views.items()} for views in taken]
        features, valid = self.features(frames, self.instruction)
        rows = zip(features.numpy(), valid.numpy(), strict=True)
        for robot, views, (row, real) in zip(due, taken, rows, strict=True):
            times = np.array([time for time, _ in views.values()])
            robot.see(SeenFeatures(row, real, times), self.wanted.latency_ms / 1000)

    def _chunks(
        self, asking: Sequence[_Robot], ablation: RolloutAblation | None
    ) -> NDArray[np.float32]:
        """The head's chunks (robot, horizon, action) for robots that ask for one.

        A stream that is off has its true ages and gaps; one that is frozen is all as it was first.
        """
        guides = [robot.loop.ask() for robot in asking]
        fields = [robot.memory.observation() for robot in asking]
        if ablation is not None:
            name, how = ablation.split()
            mean = self.checkpoint.typical(name).astype(np.float32)
            for robot, own in zip(asking, fields, strict=True):
                if how == "off":
                    own[name] = np.broadcast_to(mean, own[name].shape)
                else:
                    now = {key: value for key, value in own.items() if stream_of(key) == name}
                    robot.first = robot.first or now
                    own |= robot.first
        streams = {name: np.stack([own[name] for own in fields]) for name in fields[0]}
        observation = self.policy.observe(streams)
        guide = stack_guides(guides, observation.features.device)
        generators = [robot.generator for robot in asking]
        return self.policy.act(observation, generators, guide).cpu().numpy()


def _episode(
    controller: str, level: str, insertion: NeedleInsertion, stop: str | None
) -> RolloutEpisode:
    """What is told of an episode that has ended, by its outcome or by a safe stop."""
    progress, trace = insertion.progress, insertion.trace()
    reason = stop or str(insertion.outcome)
    return RolloutEpisode(
        controller=controller,
        seed=insertion.layout.seed,
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
