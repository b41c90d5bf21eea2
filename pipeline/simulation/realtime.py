"""The simulated arm in real time: one simulated tick for each action, cameras on their own thread.

The simulation has ticks of 0.1 s only. At a higher rate its world is faster than the real one: at
100 Hz, ten simulated seconds pass in a real one. The robot gives all times in real seconds, so its
clock keeps pace with the monotonic one: readings that are 1.5 ms apart in the simulation are then
0.15 ms apart.
"""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.environment import InsertionEnvironment, Readings, Shots
from pipeline.simulation.insertion import TICK_HZ, TICK_S
from pipeline.simulation.recorder import CAMERA_HZ

_STREAMS = ("state", "sensor")
_FRAME_S = 0.9 / CAMERA_HZ
"""Least time between two frames, however fast the simulation is: each frame takes 6 ms."""


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
        self._environment = InsertionEnvironment(cameras=False)
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
        for name in _STREAMS if self._unread else ():
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
