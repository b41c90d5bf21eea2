"""What a policy server notes: a line an event, and what `/status.json` shows."""

import json
import math
import threading
from collections import Counter, deque
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
        self._counts: Counter[Event] = Counter()
        shown = ("checkpoint", "step", "model_type", "action_hz", "feature_spec_digest")
        self._policy = {name: metadata[name] for name in shown}
        self._timings, self._since_s = Timings(_TIMED, _TIMINGS), monotonic()
        self._lock, self._say, self._form = threading.Lock(), say, form
        self._newest = {
            name: deque[Mapping[str, Any]](maxlen=_SHOWN) for name in ("refusals", "warnings")
        }
        self._written: dict[tuple[str, ...], tuple[float, int]] = {}
        """When the line of an event was last written, s, and how often it was left out since."""

    @property
    def connected(self) -> int:
        """The robots that are connected now."""
        return self._counts["connected"] - self._counts["left"]

    def answered(self, timing: Mapping[str, float]) -> None:
        """Note the `server_timing` of an answer; a part of 0 ms did not happen."""
        with self._lock:
            self._timings.note([timing[part] or math.nan for part in _TIMED])

    def note(self, event: Event, robot: str, text: str = "") -> None:
        """Count an event, and write its line unless the same one was written within 10 s.

        `robot` is an address. Events are the same where the host and the text are; slow answers of
        a host are.
        """
        text = "".join(c if c.isprintable() else " " for c in text)  # a client forges no line
        key = (event, robot.rpartition(":")[0], "" if event == "slow" else text)
        time = datetime.now(UTC).isoformat(timespec="milliseconds")
        record: dict[str, Any] = {"time": time, "event": event, "robot": robot, "text": text}
        with self._lock:
            now_s = monotonic()
            self._counts[event] += 1
            written_s, skipped = self._written.get(key, (-math.inf, 0))
            if now_s - written_s < _QUIET_S and event not in _EACH:
                self._written[key] = written_s, skipped + 1
                return
            if len(self._written) >= _REMEMBERED:  # strangers may make up reasons
                self._written.clear()
            self._written[key] = now_s, 0
            if skipped:
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
            latency = self._timings.document()
            newest = {name: [*events] for name, events in self._newest.items()}
            counts = {
                "connected": self.connected,
                "answered": self._timings.count,
                "refused": self._counts["refused"] + self._counts["error"],
                "busy": self._counts["busy"],
            }
        seconds = monotonic() - self._since_s
        document = {"policy": self._policy, "seconds": seconds, "counts": counts}
        return json.dumps(document | {"latency": latency} | newest)
