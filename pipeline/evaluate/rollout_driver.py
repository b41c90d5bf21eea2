"""A policy drives the simulated insertion closed loop, in this process or over the wire.

`_Driver` runs all episodes and steps several environments together. It has two kinds: one gets its
chunks from a policy in this process, the other from a server. The same seeds give the same figures,
bit for bit on one machine.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from pipeline.base.commands import command
from pipeline.base.config import Level, RolloutAblation, RolloutParams, latencies_ms
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.base.observation import Observation
from pipeline.evaluate.rollouts import (
    EXPERT,
    POLICY,
    RolloutEpisode,
    Rollouts,
    SuccessRate,
    controller_name,
    late_name,
)
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.expert import Generators, Guide
from pipeline.policy.observation import moving_channels, stream_of
from pipeline.policy.policy import Policy
from pipeline.robot.client import PolicyClient
from pipeline.robot.live_features import LiveFeatures, prove
from pipeline.robot.loop import ControlLoop, Executor, SafeStop, check_chunking
from pipeline.robot.readings import RobotMemory, SeenFeatures
from pipeline.robot.session import stack_guides
from pipeline.simulation.environment import InsertionEnvironment
from pipeline.simulation.insertion import INSERTED, TICK_HZ, NeedleInsertion
from pipeline.simulation.insertion_formats import INSTRUCTION
from pipeline.simulation.rendering import VIEWS, photograph

SIDE_BY_SIDE: Final = 50
"""Environments that are stepped together and share passes of a model in this process."""

Act = Callable[[Observation, Generators, Guide | None], Tensor]
"""Answers observations with chunks (robot, horizon, action), as `Policy.act` does."""
Chunk = NDArray[np.float32]
Readings = Mapping[str, NDArray[Any]]


def roll_out(
    checkpoint: PolicyCheckpoint,
    name: str,
    policy: Policy,
    load_features: Callable[[], LiveFeatures],
    wanted: RolloutParams,
    say: Callable[[str], None] = lambda line: None,
    act: Act | None = None,
) -> Rollouts:
    """Run the policy, also with latencies and with streams ablated, and the demonstrator.

    `act` answers in place of the policy's own `act`: it is that of an exported head. `say` prints a
    line for each controller when its episodes have ended. If the policy uses features,
    `load_features` is called after everything else was checked, and before the first episode the
    model proves that it gives the policy's features (`prove`). Raises `CheckpointMismatch` where
    the phantom lacks what the policy was trained on, and `ConfigError` for an instruction that the
    policy was not trained on, for chunking that its expert cannot do and for more steps than a
    chunk has.
    """
    shape, source = checkpoint.shape, checkpoint.source
    metadata = {key: source[key] for key in ("streams", "action_hz", "vlm_reuse_count")} | {
        "checkpoint": name,
        "step": checkpoint.step,
        "weights": checkpoint.digest,
        "model_type": policy.params.model_type,
        "instructions": checkpoint.instructions,
        "horizon": policy.params.horizon,
        "moving": moving_channels(source["streams"]["action"]),
        "stochastic": policy.stochastic and act is None,
        "uses_features": "features" in policy.encoders,
    }
    widths = {"action": shape.action_dim, "state": shape.state_dim, "sensor": shape.sensor_channels}
    driver = _LocalDriver(metadata, widths, wanted, checkpoint, policy, act or policy.act)
    if metadata["uses_features"]:
        driver.features = load_features()
        prove(checkpoint, driver.features, say)
    alone = len(policy.encoders) == 1
    ablations: list[RolloutAblation] = [
        ablation
        for ablation in dict.fromkeys(wanted.ablations)
        if ablation.split()[0] in policy.encoders and not (alone and ablation.endswith("off"))
    ]
    return driver.run(ablations, say)


def roll_out_served(
    server: PolicyClient, wanted: RolloutParams, say: Callable[[str], None] = lambda line: None
) -> Rollouts:
    """Run a served policy, one episode after another, and the demonstrator.

    The simulation waits for each answer, and delays frames to simulate a latency. With
    `rollout.execute` 1 a policy does the same as in `roll_out`, bit for bit if both compute one row
    at a time on one thread. No stream is ablated. Raises as `roll_out` does.
    """
    streams = server.metadata["streams"]
    widths = {
        name: len(streams[name]["names"]) if streams.get(name) else 0
        for name in ("action", "state", "sensor")
    }
    return _ServedDriver(server.metadata, widths, wanted, server).run((), say)


def _refuse_other_robot(source: Mapping[str, Any], widths: Mapping[str, int]) -> None:
    """Raise `CheckpointMismatch` where the phantom lacks what a policy was trained on.

    `source` has `streams` and `action_hz`; `widths` are those of action, state and sensor, 0 for a
    stream that the policy does not use.
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


def _instruction_of(trained: Sequence[str]) -> str:
    """The instruction for the robot: the phantom's task, or the only one of the training.

    Raises `ConfigError` where the policy was trained on several others.
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


def _begin_episode(source: Mapping[str, Any], level: Level, seed: int) -> InsertionEnvironment:
    """The phantom at the beginning of an episode, with actions as in a policy's `source`."""
    rotation = "rotvec" if "rx" in source["streams"]["action"]["names"] else "euler_delta"
    environment = InsertionEnvironment(level, rotation, cameras=False)
    environment.reset(seed=seed)
    return environment


def _episode(
    controller: str, level: str, insertion: NeedleInsertion, stop: str | None
) -> RolloutEpisode:
    """The record of an episode that has ended, by its outcome or by a safe stop."""
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


@dataclass
class _Unsent:
    """What a server does not have yet; in the place of the `RobotMemory` of a policy here."""

    ticks: list[Readings] = field(default_factory=list[Readings])
    """The readings of each tick since the last observation."""
    features: Mapping[str, Any] | None = None
    """The newest frames with their times, empty once they are sent; None before the first."""

    def sense(self, readings: Readings) -> None:
        """Keep the readings, to send them with the next observation."""
        self.ticks.append(readings)


Memory = TypeVar("Memory", RobotMemory, _Unsent)


@dataclass
class _Robot(Generic[Memory]):
    """One environment with its control loop, and why it stopped safely."""

    environment: InsertionEnvironment
    loop: ControlLoop
    memory: Memory
    latency_s: float
    """How long a pass of the model takes."""
    ablation: RolloutAblation | None
    generator: torch.Generator
    """Draws the noise of a policy in this process."""
    stop: str | None = None
    time_s: float = 0.0
    under_way: tuple[float, Any] | None = None
    """When the current pass of the model ends, and its result; None without a pass."""
    first: dict[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    """The fields of a frozen stream as they were first."""

    def sense(self, readings: Readings) -> None:
        """Begin a tick with the readings since the last one."""
        self.loop.begin_tick()
        self.time_s = float(readings["time"][0])
        self.memory.sense(readings)
        self._end_pass()

    def see(self, seen: Any) -> None:
        """Begin a pass of the model; its result is in the memory `latency_s` from now."""
        self.loop.pass_began()
        self.under_way = self.time_s + self.latency_s, seen
        self._end_pass()

    def _end_pass(self) -> None:
        if self.under_way is not None and self.time_s >= self.under_way[0] - 1e-9:
            self.memory.features = self.under_way[1]
            self.under_way = None
            self.loop.pass_ended()

    def plan(self, chunk: Chunk) -> None:
        """Take the requested chunk; a NaN or an infinity in it stops the robot."""
        try:
            self.loop.plan(chunk)
        except SafeStop as stop:
            self.stop = f"safe stop: {stop}"

    def step(self) -> None:
        """Act for one tick; stand still until the first chunk has come."""
        action = self.loop.action()
        still = np.zeros(self.environment.action_space.shape or ())
        self.sense(self.environment.step(still if action is None else action)[0])

    @property
    def active(self) -> bool:
        """Whether the episode goes on."""
        return self.stop is None and not self.environment.insertion.finished


@dataclass
class _Driver(ABC, Generic[Memory]):
    """Runs a policy on robots to the ends of their episodes."""

    side_by_side: ClassVar = 1
    """The most robots that are driven together."""
    metadata: Mapping[str, Any]
    """Describes the policy, as a server does."""
    widths: Mapping[str, int]
    """Channels of action, state and sensor; 0 for a stream that the policy does not use."""
    wanted: RolloutParams

    def __post_init__(self) -> None:
        _refuse_other_robot(self.metadata, self.widths)
        check_chunking(self.wanted.chunking, self.metadata["stochastic"])
        self._executor()
        self.instruction = _instruction_of(self.metadata["instructions"])

    def _executor(self) -> Executor:
        wanted, metadata = self.wanted, self.metadata
        return Executor(wanted.chunking, wanted.execute, metadata["horizon"], metadata["moving"])

    def run(self, ablations: Sequence[RolloutAblation], say: Callable[[str], None]) -> Rollouts:
        """Run the policy with each latency, then with each ablation, and the demonstrator."""
        wanted = self.wanted
        seeds = range(wanted.seed, wanted.seed + wanted.episodes)
        groups = [
            seeds[at : at + self.side_by_side] for at in range(0, len(seeds), self.side_by_side)
        ]
        episodes: list[RolloutEpisode] = []
        first_ms, *others_ms = latencies_ms(wanted.latency_ms)
        ways: list[tuple[str, float, RolloutAblation | None]] = [
            (POLICY, first_ms, None),
            *((late_name(latency_ms), latency_ms, None) for latency_ms in others_ms),
            *((ablation, first_ms, ablation) for ablation in ablations),
        ]
        with tqdm(total=(1 + len(ways)) * len(seeds), unit="episode", disable=None) as bar:
            for controller, latency_ms, ablation in ways:
                bar.set_description(controller)
                for group in groups:
                    robots = [self._begin(seed, latency_ms / 1000, ablation) for seed in group]
                    self._drive(robots, bar)
                    episodes += [
                        _episode(controller, wanted.level, robot.environment.insertion, robot.stop)
                        for robot in robots
                    ]
                rate = SuccessRate.of([e.success for e in episodes if e.controller == controller])
                say(f"{controller_name(controller)}: {rate} of {rate.episodes} episodes")
            bar.set_description(EXPERT)
            for seed in seeds:
                insertion = _begin_episode(self.metadata, wanted.level, seed).insertion
                while not insertion.finished:
                    insertion.step(insertion.expert_action())
                episodes.append(_episode(EXPERT, wanted.level, insertion, None))
                bar.update()
        settings = wanted.model_dump(mode="json", exclude={"checkpoint", "output", "device"})
        described = ("checkpoint", "step", "weights", "model_type")
        settings |= {key: self.metadata[key] for key in described}
        settings["instruction"] = self.instruction
        return Rollouts(settings["checkpoint"], settings, tuple(episodes))

    def _begin(
        self, seed: int, latency_s: float, ablation: RolloutAblation | None
    ) -> _Robot[Memory]:
        """A robot at the beginning of an episode, with its own generator of noise."""
        environment = _begin_episode(self.metadata, self.wanted.level, seed)
        reuse, uses_features = (self.metadata[k] for k in ("vlm_reuse_count", "uses_features"))
        loop = ControlLoop(self._executor(), reuse, uses_features)
        generator = torch.Generator().manual_seed(seed)
        return _Robot(environment, loop, self.remember(seed), latency_s, ablation, generator)

    def _drive(self, robots: Sequence[_Robot[Memory]], bar: "tqdm[Any]") -> None:
        """Run the episodes of these robots to their ends."""
        for robot in robots:
            robot.sense(robot.environment.readings())
        active = robots
        while active:
            if seeing := [robot for robot in active if self.looks(robot.loop)]:
                self.look(seeing)
            due = [
                robot
                for robot in active
                if robot.loop.chunk_due
                and (robot.memory.features is not None or not self.metadata["uses_features"])
            ]
            if due:
                for robot, chunk in zip(due, self.answer(due), strict=True):
                    robot.plan(chunk)
            for robot in active:
                if robot.stop is None:
                    robot.step()
            going = [robot for robot in active if robot.active]
            bar.update(len(active) - len(going))
            active = going

    @abstractmethod
    def remember(self, seed: int) -> Memory:
        """The empty memory of a robot whose episode of this seed begins."""

    def looks(self, loop: ControlLoop) -> bool:
        """Whether the robot of this loop takes frames in this tick."""
        return loop.frames_due

    @abstractmethod
    def look(self, robots: Sequence[_Robot[Memory]]) -> None:
        """Begin a pass of the model for each of these robots."""

    @abstractmethod
    def answer(self, robots: Sequence[_Robot[Memory]]) -> Sequence[Chunk] | Chunk:
        """The chunk (horizon, action) of each of these robots."""


@dataclass
class _LocalDriver(_Driver[RobotMemory]):
    """Drives robots by a policy in this process; robots share the passes of model and head.

    Each robot draws noise from its own generator, so it acts as it would alone.
    """

    side_by_side = SIDE_BY_SIDE
    checkpoint: PolicyCheckpoint
    policy: Policy
    act: Act
    features: LiveFeatures | None = None
    """The model; None if the policy needs none."""

    def remember(self, seed: int) -> RobotMemory:
        """A memory with the windows of the policy."""
        return RobotMemory.of(self.policy)

    def look(self, robots: Sequence[_Robot[RobotMemory]]) -> None:
        """One pass of the model for the frames of all robots; none where features are off."""
        assert self.features is not None
        trained = self.metadata["streams"]["views"]
        if robots[0].ablation == "features off":  # `answer` would replace whatever the model gives
            shape = self.checkpoint.shape
            row = np.zeros((shape.slots, shape.feature_dim), np.float32)
            for robot in robots:
                taken_s = robot.environment.frame_times()
                times = np.array([taken_s[view] for view in trained])
                robot.see(SeenFeatures(row, np.ones(shape.slots, np.bool_), times))
            return
        # Threads are enough: drawing and compressing, which take most of the time, run in parallel.
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            shots = [*pool.map(lambda robot: robot.environment.frames(), robots)]
        taken = [{view: views[view] for view in trained} for views in shots]
        frames = [{view: frame for view, (_, frame) in views.items()} for views in taken]
        features, valid = self.features(frames, self.instruction)
        rows = zip(features.numpy(), valid.numpy(), strict=True)
        for robot, views, (row, real) in zip(robots, taken, rows, strict=True):
            times = np.array([time for time, _ in views.values()])
            robot.see(SeenFeatures(row, real, times))

    def answer(self, robots: Sequence[_Robot[RobotMemory]]) -> Chunk:
        """The chunks (robot, horizon, action) of one pass of the head.

        A stream that is off keeps its true ages and gaps; all fields of a frozen one stay as they
        were first.
        """
        guides = [robot.loop.ask() for robot in robots]
        fields = [robot.memory.observation() for robot in robots]
        if (ablation := robots[0].ablation) is not None:
            name, how = ablation.split()
            mean = self.checkpoint.typical(name).astype(np.float32)
            for robot, own in zip(robots, fields, strict=True):
                if how == "off":
                    own[name] = np.broadcast_to(mean, own[name].shape)
                else:
                    now = {key: value for key, value in own.items() if stream_of(key) == name}
                    robot.first = robot.first or now
                    own |= robot.first
        streams = {name: np.stack([own[name] for own in fields]) for name in fields[0]}
        observation = self.policy.observe(streams)
        guide = stack_guides(guides, observation.features.device)
        generators = [robot.generator for robot in robots]
        return self.act(observation, generators, guide).cpu().numpy()


@dataclass
class _ServedDriver(_Driver[_Unsent]):
    """Drives robots by a policy server, which remembers one robot for each connection."""

    server: PolicyClient

    def remember(self, seed: int) -> _Unsent:
        """Nothing unsent; the server begins anew with its first observation."""
        self.server.reset(seed)
        return _Unsent()

    def looks(self, loop: ControlLoop) -> bool:
        """Only if a question follows: the server counts ticks between questions with frames."""
        return loop.frames_due and loop.chunk_due

    def look(self, robots: Sequence[_Robot[_Unsent]]) -> None:
        """Take the frames that go along with the next question, with the model's latency."""
        for robot in robots:
            fields: dict[str, Any] = {}
            taken = robot.environment.frames()
            for view in self.metadata["streams"]["views"]:
                time_s, frame = taken[view]
                fields |= {f"images/{view}": frame, f"images_time/{view}": time_s}
            robot.see(fields)

    def answer(self, robots: Sequence[_Robot[_Unsent]]) -> list[Chunk]:
        """The server's answers; waits for each."""
        return [self._ask(robot) for robot in robots]

    def _ask(self, robot: _Robot[_Unsent]) -> Chunk:
        guide, ticks = robot.loop.ask(), robot.memory.ticks
        observation: dict[str, Any] = {
            name: np.concatenate([tick[name] for tick in ticks]) for name in ticks[0]
        }
        observation |= {"time": ticks[-1]["time"], "prompt": self.instruction}
        observation |= robot.memory.features or {}
        if guide is not None:
            observation |= {"guide/chunk": guide.chunk, "guide/weight": guide.weight}
        answer = self.server.infer(observation)
        robot.memory.ticks = []
        robot.memory.features = {} if robot.memory.features is not None else None
        return answer["actions"]
