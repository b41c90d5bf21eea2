"""What a policy server notes: a line an event, and what `/status.json` shows."""

import json
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from time import monotonic
from typing import Any, Final, Literal

from pipeline.robot.run_report import Timings

Event = Literal[
    "connected", "left", "episode", "slow", "warning", "busy", "refused", "error", "turned away"
]
_REFUSALS: Final = ("busy", "refused", "error", "turned away")
_EACH: Final = ("connected", "left", "episode")
"""Events of which each is written."""
_TIMED: Final = ("vlm_ms", "head_ms", "wait_ms", "infer_ms")
_TIMINGS: Final = 5000
"""Newest answers whose latencies are kept."""
_SHOWN: Final = 20
"""Newest refusals and warnings that `/status.json` lists."""
_QUIET_S: Final = 10.0
"""How long an event that repeats is counted instead of written."""
_REMEMBERED: Final = 1000


class ServerStatus:
    """Counts, latencies and events of a server. Any thread may call it.

    `say` writes the line of an event, as text or as JSON (`form`).
    """

    def __init__(
        self,
        metadata: Mapping[str, Any],
        say: Callable[[str], None] = lambda line: None,
        form: Literal["text", "json"] = "text",
    ) -> None:
        self.connected = self.refused = self.busy = 0
        shown = ("checkpoint", "step", "model_type", "action_hz", "feature_spec_digest")
        self._policy = {name: metadata[name] for name in shown}
        self._timings, self._since_s = Timings(_TIMED, _TIMINGS), monotonic()
        self._lock, self._say, self._form = threading.Lock(), say, form
        self._newest = {
            name: deque[Mapping[str, Any]](maxlen=_SHOWN) for name in ("refusals", "warnings")
        }
        self._written_s, self._skipped = (
            dict[tuple[str, ...], float](),
            dict[tuple[str, ...], int](),
        )

    def answered(self, timing: Mapping[str, float]) -> None:
        """Note the `server_timing` of an answer; a part of 0 ms did not happen."""
        with self._lock:
            self._timings.note([timing[part] or math.nan for part in _TIMED])

    def note(self, event: Event, robot: str, text: str = "") -> None:
        """Write the line of an event, unless the same one was written within 10 s.

        `robot` is an address. Events are the same where the host and the text are; slow answers of
        a host are.
        """
        text = "".join(c if c.isprintable() else " " for c in text)  # a client forges no line
        key = (event, robot.rpartition(":")[0], "" if event == "slow" else text)
        time = datetime.now(UTC).isoformat(timespec="milliseconds")
        record: dict[str, Any] = {"time": time, "event": event, "robot": robot, "text": text}
        with self._lock:
            now_s = monotonic()
            repeats = now_s - self._written_s.get(key, -math.inf) < _QUIET_S
            if repeats and event not in _EACH:
                self._skipped[key] = self._skipped.get(key, 0) + 1
                return
            if len(self._written_s) >= _REMEMBERED:  # strangers may make up reasons
                self._written_s.clear()
                self._skipped.clear()
            self._written_s[key] = now_s
            if skipped := self._skipped.pop(key, 0):
                record["skipped"] = skipped
            if event in _REFUSALS:
                self._newest["refusals"].append(record)
            elif event == "warning":
                self._newest["warnings"].append(record)
        more = f" ({skipped} more like it)" if skipped else ""
        line = f"{time} {robot} {event}{': ' if text else ''}{text}{more}"
        with suppress(OSError):  # a log that is full or gone stops no robot
            self._say(json.dumps(record) if self._form == "json" else line)

    def json(self) -> str:
        """The content of `/status.json`."""
        with self._lock:
            answered, latency = self._timings.count, self._timings.document()
            newest = {name: [*events] for name, events in self._newest.items()}
        counts = {"connected": self.connected, "answered": answered}
        counts |= {"refused": self.refused, "busy": self.busy}
        seconds = monotonic() - self._since_s
        document = {"policy": self._policy, "seconds": seconds, "counts": counts}
        return json.dumps(document | {"latency": latency} | newest)
