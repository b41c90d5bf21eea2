"""What a policy server has answered, and to whom: the content of its `status.json`."""

import json
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Final

import numpy as np

from pipeline.robot.observation import RobotObservation
from pipeline.robot.run_report import Timings

NEWEST: Final = 5000
"""Answers whose latencies are kept."""
_PARTS: Final = ("vlm_ms", "head_ms", "wait_ms", "infer_ms")


@dataclass(eq=False)
class ConnectedRobot:
    """One connection and its newest answer."""

    peer: str
    since_s: float = field(default_factory=monotonic)
    answers: int = 0
    prompt: str | None = None
    feature_age_s: float | None = None


class ServerStatus:
    """Counts, latencies and connections of a server; any thread may write and read it."""

    def __init__(self, metadata: Mapping[str, Any]) -> None:
        self.robots: list[ConnectedRobot] = []
        self.refused = self.busy = 0
        told = ("checkpoint", "step", "model_type", "action_hz", "feature_spec_digest")
        self._policy = {name: metadata[name] for name in told}
        self._timings = Timings(_PARTS, NEWEST)
        self._since_s, self._lock = monotonic(), threading.Lock()

    @contextmanager
    def connected(self, peer: str) -> Generator[ConnectedRobot]:
        """A robot that is listed for as long as the context is open."""
        robot = ConnectedRobot(peer)
        with self._lock:
            self.robots.append(robot)
        try:
            yield robot
        finally:
            with self._lock:
                self.robots.remove(robot)

    def answered(
        self, robot: ConnectedRobot, observation: RobotObservation, answer: Mapping[str, Any]
    ) -> None:
        """Count an answer; a part that took no time does not count as one."""
        timing = answer["server_timing"]
        with self._lock:
            self._timings.note(np.array([timing[part] or np.nan for part in _PARTS]))
            robot.answers += 1
            robot.prompt = observation.prompt or robot.prompt
            robot.feature_age_s = answer.get("feature_age_s")

    def json(self) -> str:
        """The content of `status.json`."""
        now = monotonic()
        with self._lock:
            document = {
                "policy": self._policy,
                "seconds": now - self._since_s,
                "counts": {
                    "answered": self._timings.count,
                    "refused": self.refused,
                    "busy": self.busy,
                },
                "latency": self._timings.document(),
                "robots": [vars(robot) | {"seconds": now - robot.since_s} for robot in self.robots],
            }
        return json.dumps(document)
