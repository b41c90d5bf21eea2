"""One robot's control loop: what is due in a tick, and the action of the tick. Numpy only.

Its only clock is its ticks, so a rollout and a robot in real time run the same loop. In each tick
the driver calls, in this order:

1. `begin_tick`.
2. If `frames_due`: `pass_began`, and `pass_ended` when the features of these frames are ready.
3. If `chunk_due`: `ask`, and `plan` with the answered chunk, at once or some ticks later.
4. `action`.
"""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pipeline.robot.chunking import Executor, PlanGuide


class StopKind(StrEnum):
    """Why a robot stands still."""

    ENDED = "the robot ended the run"
    TIME = "time is up"
    BY_HAND = "stopped by hand"
    NO_CHUNK = "no chunk in time"
    OLD_FEATURES = "features too old"
    CAMERA = "camera missing or late"
    STALLED = "readings stalled"
    NOT_A_NUMBER = "not a number"
    LIMIT = "action beyond limits"
    FORCE = "too much force"
    WORKSPACE = "outside the workspace"
    CLOCK = "clock"
    MISSED = "missed ticks"
    HUNG = "the loop hangs"
    POLICY = "the policy failed"
    CONNECTION = "connection lost"
    ROBOT = "the robot's code failed"
    RECORDER = "the recorder failed"
    LOOP = "the loop failed"


class SafeStop(Exception):
    """The robot has to stand still from now on; the message is the reason."""

    def __init__(self, kind: StopKind, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


class ControlLoop:
    """The loop of a policy.

    With `uses_features` the policy needs the model, which makes one pass in `reuse` ticks.
    """

    def __init__(self, executor: Executor, reuse: int, uses_features: bool) -> None:
        self.executor, self._reuse, self._uses_features = executor, reuse, uses_features
        self.reset()

    def reset(self) -> None:
        """Begin the next episode."""
        self.executor.reset()
        self._tick, self._pass_began, self._asked = -1, -self._reuse, -1
        self._under_way = False

    def begin_tick(self) -> None:
        """Begin a tick."""
        self._tick += 1

    @property
    def frames_due(self) -> bool:
        """Whether the model is free, and the newest pass began `reuse` ticks ago or earlier."""
        waited = self._tick - self._pass_began >= self._reuse
        return self._uses_features and not self._under_way and waited

    def pass_began(self) -> None:
        """Note that a pass of the model began on frames of this tick."""
        self._pass_began, self._under_way = self._tick, True

    def pass_ended(self) -> None:
        """Note that the features of the last pass are ready."""
        self._under_way = False

    @property
    def chunk_due(self) -> bool:
        """Whether to ask for the next chunk; never between `ask` and `plan` or `refused`."""
        return self.executor.due

    def ask(self) -> PlanGuide | None:
        """Note that the next chunk is requested now; returns the plan that it should continue."""
        self._asked = self._tick
        return self.executor.begin()

    def refused(self) -> None:
        """Note that the last question is not answered and its frames were not used."""
        self.executor.refused()
        if self._pass_began == self._asked:
            self._pass_began, self._under_way = self._asked - self._reuse, False

    def plan(self, chunk: NDArray[np.float32]) -> None:
        """Take the answered chunk (horizon, action), in physical units.

        Raises `SafeStop` for a chunk with a NaN or an infinity.
        """
        if not np.isfinite(chunk).all():
            raise SafeStop(StopKind.NOT_A_NUMBER, "the policy's action is not a number")
        self.executor.plan(chunk)

    def action(self) -> NDArray[np.float64] | None:
        """The action of this tick; None, which means stand still, before the first chunk.

        Raises `SafeStop` if the plan is used up before the next chunk has come.
        """
        if not self.executor.planned:
            return None
        if not self.executor.reaches:
            raise SafeStop(StopKind.NO_CHUNK, "the plan is used up, and no chunk came in time")
        return self.executor.next_action().astype(np.float64)
