"""A policy drives a simulated robot closed loop, in this process or over the wire.

`_Driver` runs all episodes and steps several environments together. It has two kinds: one gets its
chunks from a policy in this process, the other from a server. The same seeds give the same figures,
bit for bit on one machine.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Final, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.config import (
    PHANTOM,
    RolloutAblation,
    RolloutParams,
    environments,
    latencies_ms,
)
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.base.printed_commands import command
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
from pipeline.policy.policy import Policy
from pipeline.robot.client import PolicyClient
from pipeline.robot.live_features import LiveFeatures, prove
from pipeline.robot.loop import ControlLoop, Executor, SafeStop, check_chunking
from pipeline.robot.readings import RobotMemory, SeenFeatures
from pipeline.robot.session import policy_metadata, stack_guides
from pipeline.simulation.environment import InsertionEnvironment, environment_maker
from pipeline.simulation.interface import Action, EnvironmentRobot, RobotEnvironment, Shots

SIDE_BY_SIDE: Final = 50
"""Environments that are stepped together and share passes of a model in this process."""

Chunk = NDArray[np.float32]
Readings = Mapping[str, NDArray[Any]]


def roll_out(
    checkpoint: PolicyCheckpoint,
    name: str,
    policy: Policy,
    load_features: Callable[[], LiveFeatures],
    wanted: RolloutParams,
    say: Callable[[str], None] = lambda line: None,
) -> Rollouts:
    """Run the policy, also with latencies and with streams ablated, and the demonstrator.

    `say` prints a line for each controller when its episodes have ended. If the policy uses
    features, `load_features` is called after everything else was checked, and before the first
    episode the model proves that it gives the policy's features (`prove`). Raises
    `CheckpointMismatch` where an environment lacks what the policy was trained on, and
    `ConfigError` for an unknown environment, for an instruction that the policy was not trained on,
    for chunking that its expert cannot do and for more steps than a chunk has.
    """
    shape, metadata = checkpoint.shape, policy_metadata(checkpoint, policy, name)
    widths = {"action": shape.action_dim, "state": shape.state_dim, "sensor": shape.sensor_channels}
    drivers = [
        _LocalDriver(metadata, widths, wanted, make, checkpoint, policy)
        for make in _environments(metadata, wanted)
    ]
    features = None
    if metadata["uses_features"]:
        features = load_features()
        prove(checkpoint, features, say)
    ablations: list[RolloutAblation] = [
        ablation
        for ablation in dict.fromkeys(wanted.ablations)
        if ablation.split()[0] in policy.encoders and len(policy.encoders) > 1
    ]
    for driver in drivers:
        driver.features = features
    return _all(drivers, ablations, say)


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
    makers = _environments(server.metadata, wanted)
    drivers = [_ServedDriver(server.metadata, widths, wanted, make, server) for make in makers]
    return _all(drivers, (), say)


def _environments(
    source: Mapping[str, Any], wanted: RolloutParams
) -> list[Callable[[], RobotEnvironment]]:
    """What makes each environment of `rollout.environment`, for a policy of this source."""
    names = source["streams"]["action"]["names"]
    return [
        environment_maker(name, wanted.level, names) for name in environments(wanted.environment)
    ]


def _all(
    drivers: "Sequence[_Driver[Any]]",
    ablations: Sequence[RolloutAblation],
    say: Callable[[str], None],
) -> Rollouts:
    """The rollouts of all drivers, one after another."""
    wanted, metadata = drivers[0].wanted, drivers[0].metadata
    for driver in drivers:
        for line in _renamed(metadata["streams"], driver.widths, driver.robot):
            say(f"warning: {line}")
    episodes = [episode for driver in drivers for episode in driver.run(ablations, say)]
    settings = wanted.model_dump(mode="json", exclude={"checkpoint", "output", "device"})
    described = ("checkpoint", "step", "weights", "model_type")
    settings |= {key: metadata[key] for key in described}
    instructions = {driver.robot.level: driver.instruction for driver in drivers}
    settings["instruction"] = instructions if len(drivers) > 1 else drivers[0].instruction
    return Rollouts(settings["checkpoint"], settings, tuple(episodes))


def _refuse_other_robot(
    source: Mapping[str, Any], widths: Mapping[str, int], robot: EnvironmentRobot
) -> None:
    """Raise `CheckpointMismatch` where an environment lacks what a policy was trained on.

    `source` has `streams` and `action_hz`; `widths` are those of action, state and sensor, 0 for a
    stream that the policy does not use.
    """
    streams, hz = source["streams"], source["action_hz"]
    kind, views = streams["action"]["kind"], streams["views"]
    own = {name: len(channels.names) if channels else 0 for name, channels in robot.streams.items()}
    fits = all(width in (own[name], 0) for name, width in widths.items())
    same = kind == robot.action_kind and hz == robot.hz and set(views) <= set(robot.views)
    if not (fits and same and widths["action"]):
        raise CheckpointMismatch(
            f"rollout.environment: the policy was trained on another robot than {robot.name}: "
            f"{_described(views, kind, widths, hz)}, of {robot.name} "
            f"{_described(robot.views, robot.action_kind, own, robot.hz)}. Name the environment of "
            "its robot, such as metaworld:TASK (docs/rollout.md), or judge it on its own "
            f"recordings ({command('evaluate')}) and set rollout.environment to null, which leaves "
            "rollouts out of dvc repro."
        )


def _renamed(
    streams: Mapping[str, Any], widths: Mapping[str, int], robot: EnvironmentRobot
) -> Iterator[str]:
    """A line for each stream whose channels the policy was trained on by other names or units."""
    for name, own in robot.streams.items():
        trained = streams.get(name)
        if not (widths[name] and own and trained):
            continue
        units = zip(own.units, trained["units"], strict=False)
        known = [(mine, other) for mine, other in units if mine and other]
        if [*own.names] != [*trained["names"]] or any(mine != other for mine, other in known):
            told = [
                ", ".join(f"{one} {unit}".strip() for one, unit in zip(names, units, strict=False))
                for names, units in ((own.names, own.units), (trained["names"], trained["units"]))
            ]
            yield (
                f"rollout.environment: {robot.name} has {name} channels {told[0]}; the policy was "
                f"trained on {told[1]}. They have to be the same quantities in the same order"
            )


def _described(views: Sequence[str], kind: str, widths: Mapping[str, int], hz: float | None) -> str:
    channels = ", ".join(f"{name} channels {width}" for name, width in widths.items())
    rate = "null" if hz is None else f"{hz:g}"
    return f"views {', '.join(views)}, action {kind}, {channels}, action_hz {rate}"


def _instruction_of(trained: Sequence[str], robot: EnvironmentRobot) -> str:
    """The instruction for the robot: its environment's, or the only one of the training.

    Raises `ConfigError` where the policy was trained on several others.
    """
    if not trained or robot.instruction in trained:
        return robot.instruction
    if len(trained) == 1:
        return trained[0]
    raise ConfigError(
        f"rollout: the policy was trained on other instructions than {robot.instruction!r}: "
        f"{', '.join(map(repr, trained))}. Train it on that of {robot.name}, or on one: "
        "data.sources[].instruction"
    )


def _played_again(
    environment: RobotEnvironment, seed: int, actions: Sequence[Action], after: Sequence[int]
) -> list[Shots]:
    """The frames that were newest after so many of these actions, of the episode of this seed."""
    environment.reset(seed=seed)
    shots = {0: environment.frames()} if 0 in after else {}
    for played, action in enumerate(actions[: max(after)], 1):
        environment.step(action)
        if played in after:
            shots[played] = environment.frames()
    return [shots[played] for played in after]


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
class _Attempt:
    """An episode of an environment under way; it begins when this is made."""

    environment: RobotEnvironment
    seed: int
    actions: list[Action] = field(default_factory=list[Action])
    ended: bool = False
    info: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        self.readings, self.info = self.environment.reset(seed=self.seed)

    def step(self, action: Action) -> None:
        """Carry out one tick."""
        self.readings, _, done, late, self.info = self.environment.step(action)
        self.ended = done or late
        self.actions.append(action)

    def record(self, controller: str, stop: str | None = None) -> RolloutEpisode:
        """The record of the episode, which has ended, by its outcome or by a safe stop."""
        environment, robot = self.environment, self.environment.robot
        if stop is None and "success" not in self.info:
            raise ConfigError(
                f"rollout.environment: {robot.name}: expected `success` in the info of the last "
                f"step, found {', '.join(self.info) or 'nothing'}"
            )
        success = stop is None and bool(self.info["success"])
        ended = self.info.get("reason", "succeeded" if success else "failed")
        time_s = float(self.readings["time"][0])
        insertion = isinstance(environment, InsertionEnvironment)
        return RolloutEpisode(
            controller=controller,
            seed=self.seed,
            level=robot.level,
            success=success,
            reason=stop or str(ended),
            figures=environment.figures(),
            time_s=time_s,
            ticks=round(time_s * robot.hz),
            frames=partial(_played_again, environment, self.seed, self.actions),
            actions=len(self.actions),
            trace=environment.insertion.trace() if insertion else None,
        )


@dataclass
class _Robot(Generic[Memory]):
    """One episode with its control loop, and why it stopped safely."""

    episode: _Attempt
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

    @property
    def environment(self) -> RobotEnvironment:
        """Where the robot is."""
        return self.episode.environment

    def sense(self) -> None:
        """Begin a tick with the readings since the last one."""
        self.loop.begin_tick()
        self.time_s = float(self.episode.readings["time"][0])
        self.memory.sense(self.episode.readings)
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
        self.episode.step(self.environment.still() if action is None else action)
        self.sense()

    @property
    def active(self) -> bool:
        """Whether the episode goes on."""
        return self.stop is None and not self.episode.ended


def _shots(robots: Sequence[_Robot[Any]]) -> list[Shots]:
    """The newest frames of each robot."""
    if not robots[0].environment.draws_in_threads:
        return [robot.environment.frames() for robot in robots]
    # Threads are enough: drawing and compressing, which take most of the time, run in parallel.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return [*pool.map(lambda robot: robot.environment.frames(), robots)]


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
    make: Callable[[], RobotEnvironment]

    def __post_init__(self) -> None:
        self.environments = [self.make()]
        """They are used again: what an environment loads, such as a scene, is loaded once."""
        self.robot = self.environments[0].robot
        _refuse_other_robot(self.metadata, self.widths, self.robot)
        check_chunking(self.wanted.chunking, self.metadata["stochastic"])
        self._executor()
        self.instruction = _instruction_of(self.metadata["instructions"], self.robot)

    def _executor(self) -> Executor:
        wanted, metadata = self.wanted, self.metadata
        return Executor(wanted.chunking, wanted.execute, metadata["horizon"], metadata["moving"])

    def run(
        self, ablations: Sequence[RolloutAblation], say: Callable[[str], None]
    ) -> list[RolloutEpisode]:
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
        where = "" if self.robot.name == PHANTOM else f"{self.robot.level}, "
        with tqdm(total=(1 + len(ways)) * len(seeds), unit="episode", disable=None) as bar:
            for controller, latency_ms, ablation in ways:
                bar.set_description(controller)
                for group in groups:
                    robots = self._begin(group, latency_ms / 1000, ablation)
                    self._drive(robots, bar)
                    episodes += [robot.episode.record(controller, robot.stop) for robot in robots]
                rate = SuccessRate.of([e.success for e in episodes if e.controller == controller])
                say(f"{where}{controller_name(controller)}: {rate} of {rate.episodes} episodes")
            bar.set_description(EXPERT)
            episodes += self._demonstrated(seeds, bar)
        return episodes

    def _demonstrated(self, seeds: Sequence[int], bar: "tqdm[Any]") -> Iterator[RolloutEpisode]:
        """The demonstrator's episodes; none where the environment has no demonstrator."""
        environment = self.environments[0]
        for seed in seeds:
            episode = _Attempt(environment, seed)
            while not episode.ended:
                action = environment.expert_action()
                if action is None:
                    return
                episode.step(action)
            yield episode.record(EXPERT)
            bar.update()

    def _begin(
        self, seeds: Sequence[int], latency_s: float, ablation: RolloutAblation | None
    ) -> list[_Robot[Memory]]:
        """A robot at the beginning of each episode, with its own generator of noise."""
        while len(self.environments) < len(seeds):
            self.environments.append(self.make())
        reuse, uses_features = (self.metadata[k] for k in ("vlm_reuse_count", "uses_features"))
        return [
            _Robot(
                _Attempt(environment, seed),
                ControlLoop(self._executor(), reuse, uses_features),
                self.remember(seed),
                latency_s,
                ablation,
                torch.Generator().manual_seed(seed),
            )
            for environment, seed in zip(self.environments, seeds, strict=False)
        ]

    def _drive(self, robots: Sequence[_Robot[Memory]], bar: "tqdm[Any]") -> None:
        """Run the episodes of these robots to their ends."""
        for robot in robots:
            robot.sense()
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
        taken = [{view: views[view] for view in trained} for views in _shots(robots)]
        frames = [{view: frame for view, (_, frame) in views.items()} for views in taken]
        features, valid = self.features(frames, self.instruction)
        rows = zip(features.numpy(), valid.numpy(), strict=True)
        for robot, views, (row, real) in zip(robots, taken, rows, strict=True):
            times = np.array([time for time, _ in views.values()])
            robot.see(SeenFeatures(row, real, times))

    def answer(self, robots: Sequence[_Robot[RobotMemory]]) -> Chunk:
        """The chunks (robot, horizon, action) of one pass of the head.

        A stream that is off keeps its true ages and gaps.
        """
        guides = [robot.loop.ask() for robot in robots]
        fields = [robot.memory.observation() for robot in robots]
        if (ablation := robots[0].ablation) is not None:
            name = ablation.split()[0]
            mean = self.checkpoint.typical(name).astype(np.float32)
            for own in fields:
                own[name] = np.broadcast_to(mean, own[name].shape)
        streams = {name: np.stack([own[name] for own in fields]) for name in fields[0]}
        observation = self.policy.observe(streams)
        guide = stack_guides(guides, observation.features.device)
        generators = [robot.generator for robot in robots]
        return self.policy.act(observation, generators, guide).cpu().numpy()


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
