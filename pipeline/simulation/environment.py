"""The needle insertion as a gymnasium environment, and as a robot that keeps pace with a clock.

`environment_maker` makes this and every other environment by name.

Frames have the clocks of a real arm's cameras. The simulation has ticks of 0.1 s only. At a higher
rate the world of `SimulatedRobot` is faster than the real one: at 100 Hz, ten simulated seconds
pass in a real one. It gives all times in real seconds, so its clock keeps pace with the monotonic
one: readings that are 1.5 ms apart in the simulation are then 0.15 ms apart.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, get_args

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from pipeline.base.config import PHANTOM, Level
from pipeline.base.errors import ConfigError
from pipeline.base.user_classes import make_named
from pipeline.data.insertion import SENSOR, STATE
from pipeline.data.timeline import ActionRotation, pose_channels
from pipeline.simulation.insertion import (
    INSERTED,
    INSTRUCTION,
    MAX_TICKS,
    READINGS_PER_TICK,
    STATE_HZ,
    TICK_HZ,
    TICK_S,
    TIME_IS_UP,
    NeedleInsertion,
)
from pipeline.simulation.interface import EnvironmentRobot, Readings, RobotEnvironment, Shots
from pipeline.simulation.needle_sensor import READING_HZ
from pipeline.simulation.recorder import CAMERA_HZ, CAMERA_JITTER_S, LOST_FRAMES
from pipeline.simulation.rendering import VIEWS, photograph, through_jpeg

_LARGEST_ACTION: Final = 5.0
"""mm and degrees in a tick, over four times what the arm can do."""
_STATES_PER_TICK: Final = STATE_HZ // TICK_HZ
_FRAME_S: Final = 0.9 / CAMERA_HZ
"""Least time between two frames of a `SimulatedRobot`, however fast it is: each takes 6 ms."""


class InsertionEnvironment(RobotEnvironment):
    """One needle insertion for each seed; an action (7,) is added to the commanded setpoint.

    It is dx dy dz in mm in the base frame, rotation in degrees in the convention of
    `action_rotation`, and gripper (ignored). An observation has `state` (10, 12) and `sensor` (65,
    1026), the readings of the tick that ends now, `state_time`, `sensor_time` and `time` (1,),
    all times in s. Reward 1 for success; `info` has `success` and, at the end, its `reason`.
    """

    draws_in_threads = True

    def __init__(self, level: Level = "full", action_rotation: ActionRotation = "rotvec") -> None:
        """The environment at this level, with actions of this convention.

        Raises `ValueError` for an unknown level or convention of rotations.
        """
        for value, known in ((level, get_args(Level)), (action_rotation, get_args(ActionRotation))):
            if value not in known:
                raise ValueError(f"expected one of {', '.join(known)}, found {value!r}")
        self.level: Level = level
        self.insertion = NeedleInsertion(action_rotation)
        self.robot = EnvironmentRobot(
            name=PHANTOM,
            level=level,
            instruction=INSTRUCTION,
            hz=TICK_HZ,
            action=pose_channels(action_rotation),
            action_kind="delta",
            views=VIEWS,
            state=STATE,
            sensor=SENSOR,
        )
        self.action_space = Box(-_LARGEST_ACTION, _LARGEST_ACTION, (7,), np.float32)
        self.observation_space = Dict(
            {
                "state": Box(-1e4, 1e4, (_STATES_PER_TICK, len(STATE.names)), np.float32),
                "state_time": Box(0, 1e4, (_STATES_PER_TICK,), np.float64),
                "sensor": Box(-1e4, 1e4, (READINGS_PER_TICK, len(SENSOR.names)), np.float32),
                "sensor_time": Box(0, 1e4, (READINGS_PER_TICK,), np.float64),
                "time": Box(0, 1e4, (1,), np.float64),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Readings, dict[str, Any]]:
        """Begin the episode of `seed`, or of a random seed if None."""
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31)) if seed is None else seed
        self.insertion.reset(drawn, self.level)
        clock = np.random.default_rng([drawn, 105])
        shape = (len(VIEWS), MAX_TICKS + 2)
        begun = clock.uniform(-TICK_S, 0, (len(VIEWS), 1))
        jitter = CAMERA_JITTER_S * clock.standard_normal(shape)
        self._shots = np.maximum(begun + np.arange(shape[1]) / CAMERA_HZ + jitter, 0.0)
        self._shots[:, 2:][clock.random((len(VIEWS), MAX_TICKS)) < LOST_FRAMES] = np.inf
        return self.readings(), self._info()

    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[Readings, float, bool, bool, dict[str, Any]]:
        """Carry out one tick of 0.1 s; the arm's limits bound an action beyond the action space.

        Raises `ResetNeeded` before the first episode and after the end of one, and `ValueError` for
        an action that is not seven finite numbers.
        """
        if not hasattr(self, "_shots") or self.insertion.finished:
            raise gymnasium.error.ResetNeeded("the episode has not begun, or has ended: call reset")
        self.insertion.step(np.asarray(action, np.float64))
        info, ended = self._info(), self.insertion.finished
        late = ended and str(self.insertion.outcome).startswith(TIME_IS_UP)
        return self.readings(), float(info["success"]), ended and not late, late, info

    def readings(self) -> Readings:
        """The newest observation."""
        now = self.insertion
        begun = now.time_s - TICK_S
        return {
            "state": now.state,
            "state_time": begun + np.arange(1, _STATES_PER_TICK + 1) / STATE_HZ,
            "sensor": now.sensor,
            "sensor_time": begun + np.arange(1, READINGS_PER_TICK + 1) / READING_HZ,
            "time": np.array([now.time_s]),
        }

    def frames(self) -> Shots:
        """The newest frame (126, 224, 3) of each camera, as a recording has it."""
        return {
            view: (time, through_jpeg(photograph(view, self.insertion, time)))
            for view, time in self.frame_times().items()
        }

    def frame_times(self) -> Mapping[str, float]:
        """When the newest frame of each camera was taken, in s."""
        now = self.insertion.time_s + 1e-9
        newest = [shots[shots <= now].max() for shots in self._shots]
        return dict(zip(VIEWS, map(float, newest), strict=True))

    def expert_action(self) -> NDArray[np.float64]:
        """The demonstrator's next action (7,)."""
        return self.insertion.expert_action()

    def figures(self) -> Mapping[str, float]:
        """Where the needle went.

        `lateral_mm` is the distance sideways from the target where the tissue was punctured, else
        at the end. `depth_mm` is the distance from the tip to the layer at the end, positive if the
        tip is short of it. `overshoot_mm` is the greatest distance beyond the layer.
        """
        progress, trace = self.insertion.progress, self.insertion.trace()
        return {
            "lateral_mm": float(np.hypot(*trace.lateral_mm)),
            "depth_mm": float(trace.layer_mm[-1]),
            "overshoot_mm": progress.overshoot_mm,
            "max_force_n": progress.max_force_n,
        }

    def _info(self) -> dict[str, Any]:
        outcome = self.insertion.outcome
        return {"success": outcome == INSERTED} | ({"reason": outcome} if outcome else {})


class SimulatedRobot:
    """One needle insertion as a robot that keeps pace with a clock.

    In ticks without an action the arm stands still. Once the episode is over, `observe` says how it
    `ended`. Ticks follow `clock`, in s; the cameras run in a thread, by the machine's time: close
    the robot to end it.
    """

    def __init__(
        self, hz: float = TICK_HZ, seed: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._hz, self._clock, self._scale = hz, clock, TICK_HZ / hz
        self.stopped: str | None = None
        """The reason of `stop`; None before it."""
        self._environment = InsertionEnvironment()
        self._unread: list[Readings] = [self._environment.reset(seed=seed)[0]]
        self._steps, self._began_s = 0, math.nan
        self._newest = self._taken()
        self._shutter, self._closed = threading.Event(), False
        self._cameras = threading.Thread(target=self._film, name="cameras", daemon=True)
        self._cameras.start()

    @property
    def outcome(self) -> str | None:
        """How the episode ended; None while it goes on."""
        return self._environment.insertion.outcome

    def observe(self) -> dict[str, Any]:
        """The readings since the last call; the arm has stood still in ticks without an action."""
        now = self._clock()
        if math.isnan(self._began_s):
            self._began_s = now
        # A tick that begins a little early must not count as left out: only whole ticks do.
        due = math.floor((now - self._began_s) * self._hz + 0.05)
        while self._steps < due and self.outcome is None:
            self._step(np.zeros(7))
        observed: dict[str, Any] = {"time": np.array([self._steps / self._hz])}
        for name in ("state", "sensor") if self._unread else ():
            observed[name] = np.concatenate([part[name] for part in self._unread])
            times = np.concatenate([part[f"{name}_time"] for part in self._unread])
            observed[f"{name}_time"] = self._robot_time_s(times)
        self._unread = []
        if self.outcome is not None:
            observed["ended"] = self.outcome
        return observed

    def frames(self) -> Shots:
        """The newest frame of each camera."""
        return self._newest

    def act(self, action: NDArray[np.float64]) -> None:
        """Carry out one tick of the simulation; after the end of the episode, nothing."""
        if self.stopped is None and self.outcome is None:
            self._step(action)

    def stop(self, reason: str) -> None:
        """Stand still."""
        self.stopped = reason

    def close(self) -> None:
        """Switch the cameras off."""
        self._closed = True
        self._shutter.set()
        self._cameras.join()

    def _step(self, action: NDArray[np.float64]) -> None:
        self._unread.append(self._environment.step(action)[0])
        self._steps += 1
        self._shutter.set()

    def _film(self) -> None:
        while self._shutter.wait() and not self._closed:
            self._shutter.clear()
            due_s = time.monotonic() + _FRAME_S
            self._newest = self._taken()
            time.sleep(max(0.0, due_s - time.monotonic()))

    def _taken(self) -> Shots:
        frames = self._environment.frames().items()
        return {view: (self._robot_time_s(taken_s), frame) for view, (taken_s, frame) in frames}

    def _robot_time_s(self, time_s: Any) -> Any:
        """Converts times of the episode to the robot's clock, on which its first tick ends at 0."""
        return self._scale * (time_s - TICK_S)


def environment_maker(
    name: str, level: Level, action_names: Sequence[str]
) -> Callable[[], RobotEnvironment]:
    """Makes environments of this name: `phantom`, `metaworld:TASK`, or `module:name` of the user.

    `level` is the phantom's, whose rotations follow those of the policy's `action_names`.
    """
    kind, _, task = name.partition(":")
    if name == PHANTOM:
        rotation = "rotvec" if "rx" in action_names else "euler_delta"
        return lambda: InsertionEnvironment(level, rotation)
    if kind == "metaworld":
        from pipeline.simulation.meta_world import MetaWorldEnvironment

        return lambda: MetaWorldEnvironment(task)
    return lambda: _of_the_user(name)


def _of_the_user(name: str) -> RobotEnvironment:
    made = make_named("rollout.environment", name)
    if not isinstance(made, RobotEnvironment):
        raise ConfigError(
            f"rollout.environment: {name}: expected a RobotEnvironment "
            f"(pipeline.simulation.interface), found {type(made).__name__}"
        )
    return made
