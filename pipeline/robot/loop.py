"""One robot's control loop: what is due in a tick, which action is played, why a robot stops.

The loop's only clock is its ticks, so a rollout and a robot in real time run the same loop. In each
tick the driver calls, in this order:

1. `begin_tick`.
2. If `frames_due`: `pass_began`, and `pass_ended` when the features of these frames are ready.
3. If `chunk_due`: `ask`, and `plan` with the answered chunk, at once or some ticks later.
4. `action`.

Numpy only; `pipeline.robot.session.stack_guides` makes tensors of guides.
"""

from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.base.errors import ConfigError

# The robot's computer needs no pydantic.
if TYPE_CHECKING:
    from pipeline.base.config import Chunking

Steps = NDArray[np.float32]

ENSEMBLE_GROWTH = 0.2
"""Of temporal ensembling: the larger, the more a new chunk counts. It is -0.01 in Zhao et al. 2023:
with that, policies that draw their chunks insert less often."""

DELAYS = 10
"""Newest delays, the largest of which the next one is expected not to exceed."""


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


@dataclass(frozen=True)
class PlanGuide:
    """The rest of a robot's plan; step 0 belongs to the tick of the observation.

    `chunk` (horizon, action) is in physical units, `weight` (horizon,) in [0, 1]; both are 0 where
    the plan has ended.
    """

    chunk: Steps
    weight: Steps


@dataclass(frozen=True)
class _Chunk:
    """A chunk whose step 0 belongs to tick `start`.

    `wanted` (horizon, action) is the place after each step, counted from where the robot was when
    the executor began; for channels that do not move it is the step itself.
    """

    start: int
    steps: Steps
    wanted: NDArray[np.float64]


class Executor:
    """Plays the action chunks of one robot, a step a call of `next_action`.

    `none` plays the newest chunk, `temporal` averages all chunks that reach a tick (`ensemble`),
    `rtc` plays the newest chunk and guides the next one by it (real-time chunking, Black et al.
    2025). A chunk's first step belongs to the tick of its observation, which `begin` marks; the
    steps that were played before `plan` takes the chunk are skipped.

    `moving` (action,) marks the channels that say how far to move; None marks none. For them a
    chunk means places: its steps add up from where the robot had been sent at the observation.
    Places are averaged, and an action leads from the last place to the next. So a motion of an
    older chunk is not repeated, but the first action of a late chunk may be as long as several
    steps: limits are the caller's. Rotations are added as vectors, which holds for small ones.

    Raises `ConfigError` where `execute`, the steps from one observation to the next, is not within
    the horizon.
    """

    def __init__(
        self,
        chunking: "Chunking",
        execute: int,
        horizon: int,
        moving: ArrayLike | None = None,
        section: str = "rollout",
    ) -> None:
        """`section` has the keys that a message names."""
        if not 1 <= execute <= horizon:
            raise ConfigError(
                f"{section}.execute: expected 1 to {horizon}, the steps of a chunk "
                f"(train_head.horizon), found {execute}"
            )
        self.chunking: "Chunking" = chunking
        self.execute, self.horizon = execute, horizon
        self._moving = np.asarray(False if moving is None else moving)
        self.reset()

    def reset(self) -> None:
        """Begin the next episode, without chunks."""
        self._tick = 0
        self._begun: int | None = None
        self._chunks: list[_Chunk] = []
        self._sent: NDArray[np.float64] | float = 0.0
        self._sent_before = self._sent_at_begin = self._sent
        self._delays: deque[int] = deque(maxlen=DELAYS)

    @property
    def due(self) -> bool:
        """Whether to observe for the next chunk before the next action.

        True before the first chunk and `execute` steps after the observation of the newest one;
        never between `begin` and `plan`.
        """
        if self._begun is not None:
            return False
        return not self._chunks or self._tick - self._chunks[-1].start >= self.execute

    @property
    def planned(self) -> bool:
        """Whether a chunk has come."""
        return bool(self._chunks)

    @property
    def reaches(self) -> bool:
        """Whether a chunk has a step for this tick."""
        return any(self._tick - chunk.start < self.horizon for chunk in self._chunks)

    def begin(self) -> PlanGuide | None:
        """Mark this tick as that of the next chunk's observation; an earlier mark is dropped.

        Returns what the policy is to continue, with `rtc` and a plan that reaches further; else
        None.
        """
        self._begun, self._sent_at_begin = self._tick, self._sent
        if self.chunking != "rtc" or not self._chunks:
            return None
        newest = self._chunks[-1]
        played, chunk = self._tick - newest.start, newest.steps
        left = chunk[played:]
        if played < self.horizon:
            sent = np.broadcast_to(self._sent, (1, chunk.shape[1]))
            left = np.where(self._moving, np.diff(newest.wanted[played:], 1, 0, sent), left)
        overlap = self.horizon - max(played, self.execute)
        if overlap <= 0:
            return None
        rest = np.zeros_like(chunk)
        rest[: len(left)] = left
        return PlanGuide(rest, soft_mask(self.horizon, max(self._delays), overlap))

    def plan(self, chunk: ArrayLike) -> None:
        """Take the chunk of the observation that `begin` marked, (horizon, action)."""
        steps = np.array(chunk, np.float32)
        assert self._begun is not None, "plan without begin: of which tick is this chunk?"
        assert steps.ndim == 2, steps.shape
        assert len(steps) == self.horizon, (len(steps), self.horizon)
        self._delays.append(self._tick - self._begun)
        places = self._sent_at_begin + np.cumsum(steps, axis=0, dtype=np.float64)
        wanted = np.where(self._moving, places, steps)
        self._chunks.append(_Chunk(self._begun, steps, wanted))
        self._begun = None

    def next_action(self) -> Steps:
        """Play this tick: its action (action,).

        A chunk must reach it: where `plan` comes too late, the caller stops the robot.
        """
        assert self.reaches, f"no action at tick {self._tick}: no chunk came in time"
        self._chunks = [c for c in self._chunks if self._tick - c.start < self.horizon]
        wanted = np.stack([chunk.wanted[self._tick - chunk.start] for chunk in self._chunks])
        self._tick += 1
        place = ensemble(wanted) if self.chunking == "temporal" else wanted[-1]
        action = place - np.where(self._moving, self._sent, 0.0)
        self._sent_before, self._sent = self._sent, np.where(self._moving, place, 0.0)
        return action.astype(np.float32)

    def sent(self, action: ArrayLike) -> None:
        """Note the action (action,) that was really sent in place of the last `next_action`.

        A moving channel's next action leads from there to the next place of the plan, so a motion
        that was cut off is made up for as soon as limits allow. A newer chunk counts from there,
        too.
        """
        self._sent = np.where(self._moving, self._sent_before + np.asarray(action), 0.0)


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
        self._tick, self._pass_began, self._under_way = -1, -self._reuse, False

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
        """Whether to ask for the next chunk; never between `ask` and `plan`."""
        return self.executor.due

    def ask(self) -> PlanGuide | None:
        """Note that the next chunk is requested now; returns the plan that it should continue."""
        return self.executor.begin()

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


def ensemble(predicted: NDArray[np.float64]) -> NDArray[np.float64]:
    """The weighted mean (action,) of predictions (prediction, action) for a tick, oldest first.

    Weights exp(-m i), i = 0 the oldest, with m = -`ENSEMBLE_GROWTH` (Zhao et al. 2023, "Learning
    Fine-Grained Bimanual Manipulation with Low-Cost Hardware", Algorithm 2).
    """
    weights = np.exp(ENSEMBLE_GROWTH * np.arange(len(predicted)))
    return np.average(predicted, axis=0, weights=weights)


def soft_mask(horizon: int, delay: int, overlap: int) -> Steps:
    """How strongly each step of a chunk is to continue the plan under way, (horizon,).

    1 for the `delay` steps that are played meanwhile, 0 from `overlap` on, where the plan ends, and
    falling between them (Black, Galliker and Levine 2025, "Real-Time Execution of Action Chunking
    Flow Policies", eq. 5, with `overlap` = H - s).
    """
    delay, step = min(delay, overlap), np.arange(horizon)
    share = (overlap - step) / (overlap - delay + 1)
    falling = share * np.expm1(share) / np.expm1(1)
    return np.where(step < delay, 1, np.where(step < overlap, falling, 0)).astype(np.float32)


def check_chunking(chunking: "Chunking", stochastic: bool, section: str = "rollout") -> None:
    """Raise `ConfigError` for `rtc` with a policy that samples nothing to guide.

    `section` has the key that the message names.
    """
    if chunking == "rtc" and not stochastic:
        raise ConfigError(
            f"{section}.chunking: expected none or temporal, as this policy draws nothing that "
            "could be guided, found rtc. Choose one of them, or train with train_head.model_type "
            "diffusion or flow_matching."
        )
