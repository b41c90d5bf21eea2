"""The needle insertion as a gymnasium environment, with the clocks of a real arm's cameras."""

from collections.abc import Mapping
from typing import Any, Final, get_args

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from pipeline.base.config import Level
from pipeline.data.insertion import SENSOR, STATE
from pipeline.data.timeline import ActionRotation
from pipeline.simulation.insertion import (
    INSERTED,
    MAX_TICKS,
    READINGS_PER_TICK,
    STATE_HZ,
    TICK_HZ,
    TICK_S,
    TIME_IS_UP,
    NeedleInsertion,
)
from pipeline.simulation.needle_sensor import READING_HZ
from pipeline.simulation.recorder import CAMERA_HZ, CAMERA_JITTER_S, LOST_FRAMES
from pipeline.simulation.rendering import HEIGHT, VIEWS, WIDTH, photograph, through_jpeg

_LARGEST_ACTION: Final = 5.0
"""mm and degrees in a tick, over four times what the arm can do."""
_STATES_PER_TICK: Final = STATE_HZ // TICK_HZ

Readings = dict[str, NDArray[Any]]
Shots = dict[str, tuple[float, NDArray[np.uint8]]]
"""By view: the capture time of its newest frame in s, and the frame (height, width, 3), RGB."""


class InsertionEnvironment(gymnasium.Env[Any, NDArray[np.floating[Any]]]):
    """One needle insertion for each seed; an action (7,) is added to the commanded setpoint.

    It is dx dy dz in mm in the base frame, rotation in degrees in the convention of
    `action_rotation`, and gripper (ignored). An observation has `state` (10, 12) and `sensor` (65,
    1026), the readings of the tick that ends now, `state_time`, `sensor_time` and `time` (1,) in s,
    and with `cameras` `images/<view>` (126, 224, 3) RGB, the newest frames; `info["frame_time"]`
    says when these were taken. Reward 1 for success; `info` has `success` and, at the end, its
    `reason`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": TICK_HZ}  # noqa: RUF012

    def __init__(
        self,
        level: Level = "full",
        action_rotation: ActionRotation = "rotvec",
        cameras: bool = True,
        render_mode: str | None = None,
    ) -> None:
        """Without `cameras` frames are drawn only when `frames` is called.

        Raises `ValueError` for an unknown level or convention of rotations.
        """
        for value, known in ((level, get_args(Level)), (action_rotation, get_args(ActionRotation))):
            if value not in known:
                raise ValueError(f"expected one of {', '.join(known)}, found {value!r}")
        self.render_mode = render_mode
        self.level: Level = level
        self.insertion = NeedleInsertion(action_rotation)
        self._cameras = cameras
        self.action_space = Box(-_LARGEST_ACTION, _LARGEST_ACTION, (7,), np.float32)
        spaces: dict[str, Any] = {
            "state": Box(-1e4, 1e4, (_STATES_PER_TICK, len(STATE.names)), np.float32),
            "state_time": Box(0, 1e4, (_STATES_PER_TICK,), np.float64),
            "sensor": Box(-1e4, 1e4, (READINGS_PER_TICK, len(SENSOR.names)), np.float32),
            "sensor_time": Box(0, 1e4, (READINGS_PER_TICK,), np.float64),
            "time": Box(0, 1e4, (1,), np.float64),
        }
        if cameras:
            image = (HEIGHT, WIDTH, 3)
            spaces |= {f"images/{view}": Box(0, 255, image, np.uint8) for view in VIEWS}
        self.observation_space = Dict(spaces)

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
        readings = {
            "state": now.state,
            "state_time": begun + np.arange(1, _STATES_PER_TICK + 1) / STATE_HZ,
            "sensor": now.sensor,
            "sensor_time": begun + np.arange(1, READINGS_PER_TICK + 1) / READING_HZ,
            "time": np.array([now.time_s]),
        }
        if self._cameras:
            readings |= {f"images/{view}": frame for view, (_, frame) in self.frames().items()}
        return readings

    def frames(self) -> Shots:
        """The newest frame (126, 224, 3) of each camera, as a recording has it."""
        return {
            view: (time, through_jpeg(photograph(view, self.insertion, time)))
            for view, time in self._frame_times().items()
        }

    def render(self) -> NDArray[np.uint8]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The newest frames side by side."""
        return np.concatenate([frame for _, frame in self.frames().values()], axis=1)

    def _frame_times(self) -> Mapping[str, float]:
        now = self.insertion.time_s + 1e-9
        newest = [shots[shots <= now].max() for shots in self._shots]
        return dict(zip(VIEWS, map(float, newest), strict=True))

    def _info(self) -> dict[str, Any]:
        outcome = self.insertion.outcome
        info = {"success": outcome == INSERTED, "frame_time": self._frame_times()}
        return info | ({"reason": outcome} if outcome else {})
