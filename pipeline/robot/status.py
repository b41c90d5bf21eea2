"""How a policy server does: what its page shows, and the page."""

import base64
import io
import json
import secrets
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.robot.observation import RobotObservation
from pipeline.robot.timings import Timings

NEWEST: Final = 5000
"""Answers whose times are kept."""
_SHOWN: Final = 224
"""Width and height of a frame on the page at most, in pixels."""
_PARTS: Final = ("vlm_ms", "head_ms", "wait_ms", "infer_ms")


@dataclass
class ConnectedRobot:
    """What is shown of one connection: its newest frames and chunk."""

    number: int
    peer: str
    since_s: float = field(default_factory=monotonic)
    answers: int = 0
    prompt: str | None = None
    feature_age_s: float | None = None
    actions: NDArray[np.float32] | None = None
    frames: dict[str, NDArray[np.uint8]] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """As JSON has it; frames as small JPEGs."""
        return vars(self) | {
            "seconds": monotonic() - self.since_s,
            "actions": None if self.actions is None else self.actions.tolist(),
            "frames": {view: _small(frame) for view, frame in sorted(self.frames.items())},
        }


class ServerStatus:
    """What a server has answered, and to whom; may be told and asked by several threads."""

    def __init__(self, metadata: Mapping[str, Any]) -> None:
        self.robots: dict[int, ConnectedRobot] = {}
        self.refused = self.busy = 0
        self._policy = {
            name: metadata[name]
            for name in ("checkpoint", "step", "model_type", "action_hz", "feature_spec_digest")
        } | {"action": metadata["streams"]["action"]}
        self._timings = Timings(_PARTS, NEWEST)
        self._numbers, self._since_s, self._lock = count(1), monotonic(), threading.Lock()

    @contextmanager
    def connected(self, peer: str) -> Generator[ConnectedRobot]:
        """While a robot is connected."""
        robot = ConnectedRobot(next(self._numbers), peer)
        with self._lock:
            self.robots[robot.number] = robot
        try:
            yield robot
        finally:
            with self._lock:
                del self.robots[robot.number]

    def answered(
        self, robot: ConnectedRobot, observation: RobotObservation, answer: Mapping[str, Any]
    ) -> None:
        """Take down an answer; a part that took no time counts as none."""
        timing = answer["server_timing"]
        with self._lock:
            self._timings.note(np.array([timing[part] or np.nan for part in _PARTS]))
            robot.answers += 1
            robot.prompt = observation.prompt or robot.prompt
            robot.feature_age_s = answer.get("feature_age_s")
            robot.actions = answer["actions"]
            robot.frames |= observation.frames

    def json(self) -> str:
        """What the page shows."""
        with self._lock:
            robots = list(self.robots.values())
            answered, latency = self._timings.count, self._timings.document()
        document = {
            "policy": self._policy,
            "seconds": monotonic() - self._since_s,
            "counts": {"answered": answered, "refused": self.refused, "busy": self.busy},
            "latency": latency,
            "robots": [robot.document() for robot in robots],
        }
        return json.dumps(document)


def page() -> tuple[str, dict[str, str]]:
    """The page, and its headers: by its Content-Security-Policy it may run its own script alone."""
    nonce = secrets.token_urlsafe(16)
    own = f"'nonce-{nonce}'"
    policy = f"default-src 'none'; script-src {own}; style-src {own}; img-src data:; "
    policy += "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    template = Path(__file__).with_name("status.html").read_text(encoding="utf-8")
    headers = {"Content-Type": "text/html; charset=utf-8", "Content-Security-Policy": policy}
    return template.replace("NONCE", nonce), headers


def _small(frame: NDArray[np.uint8]) -> str:
    image, encoded = Image.fromarray(frame), io.BytesIO()
    image.thumbnail((_SHOWN, _SHOWN))
    image.save(encoded, "JPEG", quality=75)
    return "data:image/jpeg;base64," + base64.b64encode(encoded.getvalue()).decode()
