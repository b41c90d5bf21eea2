"""A policy drives the simulated insertion closed loop, in this process or over the wire.

One loop (`_Driver.drive`) steps several environments together. It has two drivers: one gets its
chunks from a policy in this process, the other from a server. The same seeds give the same figures,
bit for bit on one machine.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

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
Seen = TypeVar("Seen")
"""The result of a pass of the model for one robot."""
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
    shape = checkpoint.shape
    widths = {"action": shape.action_dim, "state": shape.state_dim, "sensor": shape.sensor_channels}
    _refuse_other_robot(checkpoint.source, widths)
    check_chunking(wanted.chunking, policy.stochastic and act is None)
    Executor(wanted.chunking, wanted.execute, policy.params.horizon)
    features = load_features() if "features" in policy.encoders else None
    if features is not None:
        prove(checkpoint, features, say)
    instruction = _instruction_of(checkpoint.instructions)
    alone = len(policy.encoders) == 1
    ablations: list[RolloutAblation] = [
        name
        for name in dict.fromkeys(wanted.ablations)
        if name.split()[0] in policy.encoders and not (alone and name.endswith("off"))
    ]
    settings = {"checkpoint": name, "step": checkpoint.step, "weights": checkpoint.digest}
    settings |= {"model_type": policy.params.model_type, "instruction": instruction}
    driver = _LocalDriver(checkpoint, policy, features, wanted, instruction, act or policy.act)
    return _run_episodes(driver, checkpoint.source, ablations, wanted, settings, say)


def roll_out_served(
    server: PolicyClient, wanted: RolloutParams, say: Callable[[str], None] = lambda line: None
) -> Rollouts:
    """Run a served policy, one episode after another, and the demonstrator.

    The simulation waits for each answer, and delays frames to simulate a latency. With
    `rollout.execute` 1 a policy does the same as in `roll_out`, bit for bit if both compute one row
    at a time on one thread. No stream is ablated. Raises as `roll_out` does.
    """
    metadata = server.metadata
    streams = {name: metadata["streams"].get(name) for name in ("action", "state", "sensor")}
    widths = {name: len(stream["names"]) if stream else 0 for name, stream in streams.items()}
    _refuse_other_robot(metadata, widths)
    check_chunking(wanted.chunking, metadata["stochastic"])
    instruction = _instruction_of(metadata["instructions"])
    settings = {name: metadata[name] for name in ("checkpoint", "step", "model_type")}
    settings["instruction"] = instruction
    driver = _ServedDriver(server, wanted, instruction)
    return _run_episodes(driver, metadata, (), wanted, settings, say)


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


def _run_episodes(
    driver: "_Driver[Any]",
    source: Mapping[str, Any],
    ablations: Sequence[RolloutAblation],
    wanted: RolloutParams,
    settings: Mapping[str, Any],
    say: Callable[[str], None],
) -> Rollouts:
    """Run the policy with each latency, then with each ablation, and the demonstrator.

    `source` is what the policy was trained on; `settings` describe it, its `checkpoint` among them.
    """
    seeds = range(wanted.seed, wanted.seed + wanted.episodes)
    side_by_side = driver.side_by_side
    groups = [seeds[at : at + side_by_side] for at in range(0, len(seeds), side_by_side)]
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
                environments = [_begin_episode(source, wanted.level, seed) for seed in group]
                stops = driver.drive(environments, latency_ms / 1000, ablation, bar.update)
                episodes += [
                    _episode(controller, wanted.level, environment.insertion, stop)
                    for environment, stop in zip(environments, stops, strict=True)
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
    params = wanted.model_dump(mode="json", exclude={"checkpoint", "output", "device"})
    return Rollouts(settings["checkpoint"], params | dict(settings), tuple(episodes))


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
class _Robot(ABC, Generic[Seen]):
    """One environment with its control loop, and why it stopped safely."""

    environment: InsertionEnvironment
    loop: ControlLoop
    latency_s: float
    """How long a pass of the model takes."""
    stop: str | None = field(default=None, init=False)
    time_s: float = field(default=0.0, init=False)
    under_way: tuple[float, Seen] | None = field(default=None, init=False)
    """When the current pass of the model ends, and its result; None without a pass."""

    def sense(self, readings: Readings) -> None:
        """Begin a tick with the readings since the last one."""
        self.loop.begin_tick()
        self.time_s = float(readings["time"][0])
        self.remember(readings)
        self._end_pass()

    def see(self, seen: Seen) -> None:
        """Begin a pass of the model; its result is ready `latency_s` from now."""
        self.loop.pass_began()
        self.under_way = self.time_s + self.latency_s, seen
        self._end_pass()

    def _end_pass(self) -> None:
        if self.under_way is not None and self.time_s >= self.under_way[0] - 1e-9:
            self.take(self.under_way[1])
            self.under_way = None
            self.loop.pass_ended()

    @abstractmethod
    def remember(self, readings: Readings) -> None:
        """Keep these readings for the next observation."""

    @abstractmethod
    def take(self, seen: Seen) -> None:
        """Keep the result of a pass for the next observation."""

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


AnyRobot = TypeVar("AnyRobot", bound=_Robot[Any])


class _Driver(ABC, Generic[AnyRobot]):
    """Runs a policy on robots to the ends of their episodes."""

    side_by_side: int
    """The most robots that it drives together."""

    def drive(
        self,
        environments: Sequence[InsertionEnvironment],
        latency_s: float,
        ablation: RolloutAblation | None,
        ended: Callable[[], Any],
    ) -> list[str | None]:
        """Run the episodes to their ends; returns why each robot stopped safely, or None.

        A pass of the model takes `latency_s`. `ended` is called for each episode that ends.
        """
        robots = [self.begin(environment, latency_s) for environment in environments]
        for robot in robots:
            robot.sense(robot.environment.readings())
        active = robots
        while active:
            for robot, chunk in self.chunks(active, ablation):
                robot.plan(chunk)
            for robot in active:
                if robot.stop is None:
                    robot.step()
            going = [robot for robot in active if robot.active]
            for _ in range(len(active) - len(going)):
                ended()
            active = going
        return [robot.stop for robot in robots]

    @abstractmethod
    def begin(self, environment: InsertionEnvironment, latency_s: float) -> AnyRobot:
        """The robot of an environment whose episode begins."""

    @abstractmethod
    def chunks(
        self, active: Sequence[AnyRobot], ablation: RolloutAblation | None
    ) -> Iterable[tuple[AnyRobot, Chunk]]:
        """The robots whose chunk is due in this tick, each with its chunk (horizon, action)."""


@dataclass
class _LocalRobot(_Robot[SeenFeatures]):
    """A robot whose memory is in this process; it has its own generator of noise."""

    memory: RobotMemory
    generator: torch.Generator
    first: dict[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    """The fields of a frozen stream as they were first."""

    def remember(self, readings: Readings) -> None:
        """Keep them in the memory."""
        self.memory.sense(readings)

    def take(self, seen: SeenFeatures) -> None:
        """Make these features the newest."""
        self.memory.features = seen


@dataclass(frozen=True)
class _LocalDriver(_Driver[_LocalRobot]):
    """Drives robots by a policy in this process; `features` is the model, None if it needs none.

    Each robot draws noise from a generator with its own seed, so it acts as it would alone.
    """

    side_by_side = SIDE_BY_SIDE
    checkpoint: PolicyCheckpoint
    policy: Policy
    features: LiveFeatures | None
    wanted: RolloutParams
    instruction: str
    act: Act

    def begin(self, environment: InsertionEnvironment, latency_s: float) -> _LocalRobot:
        """The loop and the memory of a robot."""
        wanted, source = self.wanted, self.checkpoint.source
        moving = moving_channels(source["streams"]["action"])
        executor = Executor(wanted.chunking, wanted.execute, self.policy.params.horizon, moving)
        loop = ControlLoop(executor, source["vlm_reuse_count"], self.features is not None)
        generator = torch.Generator().manual_seed(environment.insertion.layout.seed)
        return _LocalRobot(environment, loop, latency_s, RobotMemory.of(self.policy), generator)

    def chunks(
        self, active: Sequence[_LocalRobot], ablation: RolloutAblation | None
    ) -> Iterable[tuple[_LocalRobot, Chunk]]:
        """One pass of the model for all due frames, then one of the head for all due chunks."""
        self._look([robot for robot in active if robot.loop.frames_due])
        due = [
            robot
            for robot in active
            if robot.loop.chunk_due and (self.features is None or robot.memory.features is not None)
        ]
        return zip(due, self._act(due, ablation), strict=True) if due else ()

    def _look(self, due: Sequence[_LocalRobot]) -> None:
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
            robot.see(SeenFeatures(row, real, times))

    def _act(self, due: Sequence[_LocalRobot], ablation: RolloutAblation | None) -> Chunk:
        """The chunks (robot, horizon, action).

        A stream that is off keeps its true ages and gaps; all fields of a frozen one stay as they
        were first.
        """
        guides = [robot.loop.ask() for robot in due]
        fields = [robot.memory.observation() for robot in due]
        if ablation is not None:
            name, how = ablation.split()
            mean = self.checkpoint.typical(name).astype(np.float32)
            for robot, own in zip(due, fields, strict=True):
                if how == "off":
                    own[name] = np.broadcast_to(mean, own[name].shape)
                else:
                    now = {key: value for key, value in own.items() if stream_of(key) == name}
                    robot.first = robot.first or now
                    own |= robot.first
        streams = {name: np.stack([own[name] for own in fields]) for name in fields[0]}
        observation = self.policy.observe(streams)
        guide = stack_guides(guides, observation.features.device)
        generators = [robot.generator for robot in due]
        return self.act(observation, generators, guide).cpu().numpy()


@dataclass
class _ServedRobot(_Robot[Mapping[str, Any]]):
    """A robot whose memory is on the server; the server gets frames with the model's latency."""

    sees: bool
    """Whether the server has frames of this episode, or needs none."""
    unsent: list[Readings] = field(default_factory=list[Readings])
    """The readings of each tick since the last observation."""
    frames: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """The newest frames that are not sent yet, with their times."""

    def remember(self, readings: Readings) -> None:
        """Keep them, to send them with the next observation."""
        self.unsent.append(readings)

    def take(self, seen: Mapping[str, Any]) -> None:
        """Keep them, to send them with the next observation."""
        self.frames, self.sees = seen, True


@dataclass(frozen=True)
class _ServedDriver(_Driver[_ServedRobot]):
    """Drives robots by a policy server, which remembers one robot for each connection."""

    side_by_side = 1
    server: PolicyClient
    wanted: RolloutParams
    instruction: str

    def begin(self, environment: InsertionEnvironment, latency_s: float) -> _ServedRobot:
        """The loop of a robot; the server begins anew with its first observation."""
        wanted, metadata = self.wanted, self.server.metadata
        executor = Executor(
            wanted.chunking, wanted.execute, metadata["horizon"], metadata["moving"]
        )
        loop = ControlLoop(executor, metadata["vlm_reuse_count"], metadata["uses_features"])
        self.server.reset(environment.insertion.layout.seed)
        return _ServedRobot(environment, loop, latency_s, sees=not metadata["uses_features"])

    def chunks(
        self, active: Sequence[_ServedRobot], ablation: RolloutAblation | None
    ) -> Iterable[tuple[_ServedRobot, Chunk]]:
        """The robots whose chunk is due, each with the server's answer; waits for each answer."""
        assert ablation is None, "a served policy sees what there is"
        for robot in active:
            # Only if a question follows: the server counts ticks between questions with frames.
            if robot.loop.frames_due and robot.loop.chunk_due:
                self._photograph(robot)
        asking = [robot for robot in active if robot.sees and robot.loop.chunk_due]
        return [(robot, self._ask(robot)) for robot in asking]

    def _photograph(self, robot: _ServedRobot) -> None:
        fields: dict[str, Any] = {}
        taken = robot.environment.frames()
        for view in self.server.metadata["streams"]["views"]:
            time_s, frame = taken[view]
            fields |= {f"images/{view}": frame, f"images_time/{view}": time_s}
        robot.see(fields)

    def _ask(self, robot: _ServedRobot) -> Chunk:
        guide = robot.loop.ask()
        observation: dict[str, Any] = {
            name: np.concatenate([tick[name] for tick in robot.unsent]) for name in robot.unsent[0]
        }
        observation |= {"time": robot.unsent[-1]["time"], "prompt": self.instruction}
        observation |= robot.frames
        if guide is not None:
            observation |= {"guide/chunk": guide.chunk, "guide/weight": guide.weight}
        answer = self.server.infer(observation)
        robot.unsent, robot.frames = [], {}
        return answer["actions"]
