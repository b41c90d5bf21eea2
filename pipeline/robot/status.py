"""How a policy server does: what its page shows, and the page."""

import base64
import io
import json
import secrets
import threading
from collections import deque
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.robot.observation import RobotObservation

NEWEST: Final = 5000
"""Answers whose times are kept."""
_SHOWN: Final = 224
"""Width and height of a frame on the page at most, in pixels."""
_PARTS: Final = {"vlm": "vlm_ms", "head": "head_ms", "wait": "wait_ms", "whole": "infer_ms"}


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
        shown = ("number", "peer", "answers", "prompt", "feature_age_s")
        return {name: getattr(self, name) for name in shown} | {
            "seconds": monotonic() - self.since_s,
            "actions": None if self.actions is None else self.actions.tolist(),
            "frames": {view: _small(frame) for view, frame in sorted(self.frames.items())},
        }


class ServerStatus:
    """What a server has answered, and to whom; may be told and asked by several threads."""

    def __init__(self, metadata: Mapping[str, Any]) -> None:
        self.robots: dict[int, ConnectedRobot] = {}
        self.refused = self.busy = 0
        self._answers = 0
        self._policy = {
            name: metadata[name]
            for name in ("checkpoint", "step", "model_type", "action_hz", "feature_spec_digest")
        } | {"action": metadata["streams"]["action"]}
        self._timings: deque[Mapping[str, float]] = deque(maxlen=NEWEST)
        self._since_s, self._lock = monotonic(), threading.Lock()

    @contextmanager
    def connected(self, number: int, peer: str) -> Generator[None]:
        """While a robot is connected."""
        with self._lock:
            self.robots[number] = ConnectedRobot(number, peer)
        try:
            yield
        finally:
            with self._lock:
                del self.robots[number]

    def answered(
        self, number: int, observation: RobotObservation, answer: Mapping[str, Any]
    ) -> None:
        """Take down an answer."""
        with self._lock:
            self._answers += 1
            self._timings.append(answer["server_timing"])
            if (robot := self.robots.get(number)) is None:
                return
            robot.answers += 1
            robot.prompt = observation.prompt or robot.prompt
            robot.feature_age_s = answer.get("feature_age_s")
            robot.actions = answer["actions"]
            robot.frames |= observation.frames

    def json(self) -> str:
        """What the page shows."""
        with self._lock:
            robots, timings = list(self.robots.values()), list(self._timings)
        document = {
            "policy": self._policy,
            "seconds": monotonic() - self._since_s,
            "counts": {"answered": self._answers, "refused": self.refused, "busy": self.busy},
            "latency_ms": {part: _quantiles(timings, name) for part, name in _PARTS.items()},
            "robots": [robot.document() for robot in robots],
        }
        return json.dumps(document)


def page() -> tuple[str, str]:
    """The page, and the Content-Security-Policy under which it alone may run its script."""
    nonce = secrets.token_urlsafe(16)
    own = f"'nonce-{nonce}'"
    policy = f"default-src 'none'; script-src {own}; style-src {own}; img-src data:; "
    policy += "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    return _template().replace("NONCE", nonce), policy


@cache
def _template() -> str:
    return Path(__file__).with_name("status.html").read_text(encoding="utf-8")


def _quantiles(timings: list[Mapping[str, float]], name: str) -> list[float] | None:
    """p50, p99 and p99.9 of those that took any time at all."""
    taken = [timing[name] for timing in timings if timing[name] > 0]
    return np.percentile(taken, [50, 99, 99.9]).tolist() if taken else None


def _small(frame: NDArray[np.uint8]) -> str:
    image, encoded = Image.fromarray(frame), io.BytesIO()
    image.thumbnail((_SHOWN, _SHOWN))
    image.save(encoded, "JPEG", quality=75)
    return "data:image/jpeg;base64," + base64.b64encode(encoded.getvalue()).decode()
