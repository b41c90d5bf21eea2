"""The simulated arm in real time: a tick of the simulation an action, cameras on their own thread.

The simulation knows ticks of 0.1 s alone. Run at another rate, its world goes that much faster than
life: at 100 Hz ten simulated seconds pass in each of ours. All times that the robot tells are ours,
so ages are true and its clock keeps pace with the monotonic one: a reading that comes 1.5 ms after
another in the simulation then comes 0.15 ms after it.
"""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Level
from pipeline.simulation.arm import ActionRotation
from pipeline.simulation.environment import InsertionEnvironment, Readings
from pipeline.simulation.insertion import TICK_HZ, TICK_S
from pipeline.simulation.recorder import CAMERA_HZ

Frames = dict[str, tuple[float, NDArray[np.uint8]]]
_STREAMS = ("state", "sensor")
_FRAME_S = 0.9 / CAMERA_HZ
"""Cameras take no more than so many frames, however fast the world goes: each costs 6 ms."""


class SimulatedRobot:
    """The needle insertion as a robot that lives as fast as the clock goes.

    In ticks without an action the arm stands still. With `again` the episode of the next seed
    begins where one has ended; else `observe` says that the run has `ended`. `outcomes` has how
    each episode ended. Close it: its cameras are a thread. They keep to the machine's time; ticks
    pass by `clock`, s.
    """

    def __init__(
        self,
        level: Level = "full",
        rotation: ActionRotation = "rotvec",
        hz: float = TICK_HZ,
        seed: int = 0,
        again: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._level: Level = level
        self._rotation: ActionRotation = rotation
        self._hz, self._again, self._clock = hz, again, clock
        self._scale = TICK_HZ / hz
        self.outcomes: list[str] = []
        self.stopped: str | None = None
        """Why it was told to stand still."""
        self._steps, self._began_s = 0, math.nan
        self._seed, self._next = seed, self._prepared(seed)
        self._begin(0.0)
        self._shutter, self._closed = threading.Event(), False
        self._cameras = threading.Thread(target=self._film, name="cameras", daemon=True)
        self._cameras.start()

    def observe(self) -> dict[str, Any]:
        """The readings since the last call; the arm has stood still in ticks without an action."""
        now = self._clock()
        if self._steps == 0 and math.isnan(self._began_s):
            self._began_s = now
        # A tick that begins a little early is not yet over: only whole ones were left out.
        due = math.floor((now - self._began_s) * self._hz + 0.05)
        begun = self._environment.insertion.finished and self._again
        if begun:
            self._begin(self._steps / self._hz)
        while self._steps < due and not self._environment.insertion.finished:
            self._step(np.zeros(7))
        observed: dict[str, Any] = {"time": np.array([self._steps / self._hz])}
        for name in _STREAMS if self._unread else ():
            observed[name] = np.concatenate([part[name] for part in self._unread])
            times = np.concatenate([part[f"{name}_time"] for part in self._unread])
            observed[f"{name}_time"] = self._epoch_s + self._scale * times
        self._unread = []
        if begun:
            observed["reset"] = True
        elif self._environment.insertion.finished and not self._again:
            observed["ended"] = self.outcomes[-1]
        return observed

    def frames(self) -> Frames:
        """What each camera took last."""
        return self._newest

    def act(self, action: NDArray[np.float64]) -> None:
        """Carry out one tick of the simulation; after the end of an episode, nothing."""
        if self.stopped is None and not self._environment.insertion.finished:
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
        if self._environment.insertion.finished:
            self.outcomes.append(str(self._environment.insertion.outcome))
        self._shutter.set()

    def _begin(self, now_s: float) -> None:
        """The next episode, the first tick of which ends at `now_s` on the robot's clock."""
        if self._next is None:
            self._next = self._prepared(self._seed)
        self._environment, frames = self._next
        self._seed, self._next = self._seed + 1, None
        self._epoch_s = now_s - TICK_S * self._scale
        self._newest = self._timed(frames, self._epoch_s)
        self._unread: list[Readings] = [self._environment.readings()]
        self._world = self._environment, self._epoch_s

    def _prepared(self, seed: int) -> tuple[InsertionEnvironment, Frames]:
        environment = InsertionEnvironment(self._level, self._rotation, cameras=False)
        environment.reset(seed=seed)
        return environment, environment.frames()

    def _film(self) -> None:
        while self._shutter.wait() and not self._closed:
            self._shutter.clear()
            due_s = time.monotonic() + _FRAME_S
            environment, epoch_s = world = self._world
            frames = self._timed(environment.frames(), epoch_s)
            if world is self._world:
                self._newest = frames
            if self._next is None:
                seed = self._seed
                prepared = self._prepared(seed)
                if seed == self._seed:  # Else that episode has begun meanwhile.
                    self._next = prepared
            time.sleep(max(0.0, due_s - time.monotonic()))

    def _timed(self, frames: Frames, epoch_s: float) -> Frames:
        return {view: (epoch_s + self._scale * t, frame) for view, (t, frame) in frames.items()}
