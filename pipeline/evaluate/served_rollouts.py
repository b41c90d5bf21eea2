"""Rollouts over the wire: the same episodes, with chunks that a policy server answers."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import RolloutParams
from pipeline.base.errors import ConfigError
from pipeline.evaluate.rollouts import Rollouts, instruction_of, refuse_other_robot, run_episodes
from pipeline.robot.chunking import Executor, check_chunking
from pipeline.robot.client import PolicyClient
from pipeline.robot.loop import ControlLoop, SafeStop
from pipeline.simulation.environment import InsertionEnvironment


def roll_out_served(
    server: PolicyClient, wanted: RolloutParams, say: Callable[[str], None] = lambda line: None
) -> Rollouts:
    """Episodes of a served policy, one after another, and of the demonstrator.

    The simulation waits for each answer: with `rollout.execute` 1 a policy does what it does in
    `roll_out` without latency, bit for bit where both compute one row at a time on one thread.
    Streams are not spoilt. Raises as `roll_out`, and `ConfigError` for a simulated latency.
    """
    if wanted.latency_ms:
        raise ConfigError(
            "rollout.latency_ms: expected 0 with rollout.server, whose answers are waited for, "
            f"found {wanted.latency_ms:g}. Roll out without rollout.server to simulate it."
        )
    told = server.metadata
    streams = {name: told["streams"].get(name) for name in ("action", "state", "sensor")}
    widths = {name: len(stream["names"]) if stream else 0 for name, stream in streams.items()}
    refuse_other_robot(told, widths)
    check_chunking(wanted.chunking, told["stochastic"])
    instruction = instruction_of(told["instructions"])
    settings = {name: told[name] for name in ("checkpoint", "step", "model_type")}
    settings["instruction"] = instruction

    def drive(
        robots: Sequence[InsertionEnvironment], ablation: object, ended: Callable[[], Any]
    ) -> list[str | None]:
        """One robot after another."""
        assert ablation is None, "a served policy sees what there is"
        stops: list[str | None] = []
        for robot in robots:
            try:
                _drive(server, wanted, instruction, robot)
                stops.append(None)
            except SafeStop as stop:
                stops.append(f"safe stop: {stop}")
            ended()
        return stops

    return run_episodes(drive, told, [None], wanted, settings, say)


def _drive(
    server: PolicyClient, wanted: RolloutParams, instruction: str, robot: InsertionEnvironment
) -> None:
    """Run the policy on one robot, for which the server begins anew. Raises `SafeStop`."""
    told = server.metadata
    executor = Executor(wanted.chunking, wanted.execute, told["horizon"], told["moving"])
    loop = ControlLoop(executor, told["vlm_reuse_count"], told["uses_features"])
    server.reset(robot.insertion.layout.seed)
    unsent = [robot.readings()]
    while not robot.insertion.finished:
        loop.begin_tick()
        if loop.chunk_due:
            guide = loop.ask()
            observation = _together(unsent) | {"prompt": instruction}
            if guide is not None:
                observation |= {"guide/chunk": guide.chunk, "guide/weight": guide.weight}
            if loop.frames_due:
                loop.pass_began()
                observation |= _seen(robot, told["streams"]["views"])
            answer = server.infer(observation)
            loop.pass_ended()
            loop.plan(answer["actions"])
            unsent = []
        action = loop.action()
        assert action is not None, "the first answer was waited for"
        unsent.append(robot.step(action)[0])


def _together(ticks: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, Any]:
    """The readings of several ticks as those of one; `time` is the last."""
    joined = {name: np.concatenate([tick[name] for tick in ticks]) for name in ticks[0]}
    return joined | {"time": ticks[-1]["time"]}


def _seen(robot: InsertionEnvironment, views: Sequence[str]) -> dict[str, Any]:
    """The newest frames of these views, and when each was taken."""
    frames = robot.frames()
    images = {f"images/{view}": frames[view][1] for view in views}
    return images | {f"images_time/{view}": frames[view][0] for view in views}
