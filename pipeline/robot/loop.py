"""One robot's control loop: it says what is due, and takes what came of it.

Its clock is the time that the readings bring, simulated or real, so that a rollout and a robot run
the same loop. In each tick whoever drives it asks, in this order: `sense`, then `frames_due` (and
begins a pass of the model, whose answer is handed to `see`), then `chunk_due` (and hands the head's
chunk to `plan`), then `action`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Chunking, TrainHeadParams
from pipeline.policy.observation import PolicyShape
from pipeline.robot.chunking import Executor
from pipeline.robot.memory import RobotMemory, SeenFeatures, WindowSize


class SafeStop(Exception):
    """The robot is to stand still from here on; the message is the reason."""


@dataclass(frozen=True)
class LoopTiming:
    """How often what is done: `reuse` ticks between passes of the model, `latency_s` of a pass."""

    reuse: int
    latency_s: float
    execute: int
    chunking: Chunking
    moving: tuple[bool, ...]
    """`moving_channels` of the action."""


class ControlLoop:
    """The loop of a policy of these params and widths; `uses_features` where it needs the model."""

    def __init__(
        self, params: TrainHeadParams, shape: PolicyShape, timing: LoopTiming, uses_features: bool
    ) -> None:
        self.memory = RobotMemory(
            WindowSize(params.sensor_window, shape.sensor_channels, params.sensor_reach_s),
            WindowSize(params.state_window, shape.state_dim, params.state_window_s),
        )
        self.executor = Executor(timing.chunking, timing.execute, params.horizon, timing.moving)
        self._timing, self._uses_features = timing, uses_features
        self._still = np.zeros(shape.action_dim)
        self._tick, self._pass_began = -1, -timing.reuse
        self._under_way: tuple[float, SeenFeatures] | None = None

    def sense(self, readings: Mapping[str, NDArray[Any]]) -> None:
        """Begin a tick with the readings since the last; `RobotMemory.sense` says which.

        Features whose pass has ended by now become the newest.
        """
        self._tick += 1
        self.memory.sense(readings)
        self._take_features()

    @property
    def frames_due(self) -> bool:
        """Whether the model is free, and the newest pass began `reuse` ticks ago or earlier."""
        waited = self._tick - self._pass_began >= self._timing.reuse
        return self._uses_features and self._under_way is None and waited

    def see(self, seen: SeenFeatures) -> None:
        """The answer of a pass that begins now; it is ready `latency_s` from now."""
        self._pass_began = self._tick
        self._under_way = self.memory.time_s + self._timing.latency_s, seen
        self._take_features()

    @property
    def chunk_due(self) -> bool:
        """Whether the head is to be asked; not before the first features are there."""
        return self._ready and self.executor.due

    def plan(self, chunk: NDArray[np.float32]) -> None:
        """Take the head's chunk (horizon, action), in physical units."""
        if not np.isfinite(chunk).all():
            raise SafeStop("the policy's action is not a number")
        self.executor.plan(chunk)

    def action(self) -> NDArray[np.float64]:
        """What the robot is to do in this tick: stand still until the first features are there."""
        return self.executor.next_action().astype(np.float64) if self._ready else self._still

    @property
    def _ready(self) -> bool:
        return self.memory.features is not None or not self._uses_features

    def _take_features(self) -> None:
        if self._under_way is not None and self.memory.time_s >= self._under_way[0] - 1e-9:
            self.memory.features, self._under_way = self._under_way[1], None
