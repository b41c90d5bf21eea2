"""What an inspection finds in recordings, as plain data.

Pages, pictures and the notebook read these and nothing else. All times are float64 seconds on the
recording's own clock; `EpisodeView.zero` is what pictures subtract.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.data import CameraStream, RecordedAction, Recording, Stream
from pipeline.data.timeline import ActionRotation, Timeline

Severity = Literal["error", "warning"]
ClockKind = Literal["camera", "stream", "tick", "vl_row"]


@dataclass(frozen=True)
class Flaw:
    """Something that looks wrong, and where."""

    kind: str
    """As docs/looking.md explains it: `gap`, `dead camera`, …"""
    severity: Severity
    """An error keeps extraction from using the episode; a warning does not."""
    source: str
    episode: str
    stream: str
    """`view View1`, `sensor`, `state`, …; `episode` is all of it."""
    start_s: float | None
    """None where it is all of the stream."""
    stop_s: float | None
    message: str
    """One line: what was found, beside what was expected."""


@dataclass(frozen=True)
class EpisodeView:
    """One recording with everything of it that could be read.

    What could not is None, or absent from `cameras`, and a flaw of kind `unreadable` says why.
    """

    recording: Recording
    timeline: Timeline | None
    cameras: Mapping[str, CameraStream]
    sensor: Stream | None
    state: Stream | None
    poses: Stream | None
    action: RecordedAction | None
    """As recorded; `timeline.action` is what the ticks have."""
    flaws: tuple[Flaw, ...]
    zero: float
    """The first instant of all clocks."""
    instruction: str | None = None
    """None where it could not be read; `recording.instruction` would raise."""
    action_rotation: ActionRotation = "rotvec"
    """How `timeline` derived actions from poses."""

    @property
    def streams(self) -> dict[str, Stream]:
        """The streams that could be read, by name: sensor, state, poses, action."""
        found = {
            "sensor": self.sensor,
            "state": self.state,
            "poses": self.poses,
            "action": self.action,
        }
        return {name: stream for name, stream in found.items() if stream is not None}

    @property
    def clocks(self) -> dict[str, NDArray[np.float64]]:
        """The times of all that was recorded: `view View1`, …, `sensor`, `state`, …"""
        cameras = {f"view {view}": camera.time for view, camera in self.cameras.items()}
        return cameras | {name: stream.time for name, stream in self.streams.items()}

    @property
    def duration_s(self) -> float:
        """From the first to the last instant of all clocks; 0 where nothing could be read."""
        return (
            max((float(time[-1]) for time in self.clocks.values()), default=self.zero) - self.zero
        )

    def flaw(
        self,
        kind: str,
        stream: str,
        message: str,
        start_s: float | None = None,
        stop_s: float | None = None,
        severity: Severity = "warning",
    ) -> Flaw:
        """A flaw of this episode; the times are on its own clock."""
        one = self.recording
        return Flaw(kind, severity, one.source, one.id, stream, start_s, stop_s, message)


@dataclass(frozen=True)
class Gap:
    """Where a clock skipped: from the last entry before to the first after, in seconds."""

    start_s: float
    stop_s: float


@dataclass(frozen=True)
class Clock:
    """When a stream was sampled."""

    name: str
    """`View1`, `sensor`, `state`, `poses`, `action`, `ticks`, `VL rows`; `poses` only where they
    have a clock of their own."""
    kind: ClockKind
    time: NDArray[np.float64]
    """(entry,) s."""
    rate_hz: float
    """1 / the usual step (`clocks.usual_step`); NaN for fewer than two entries."""
    jitter_s: float
    """Standard deviation of the steps that are no gaps; NaN for fewer than three entries."""
    gaps: tuple[Gap, ...]

    @property
    def mean_rate_hz(self) -> float:
        """Steps a second from the first entry to the last, gaps and all; NaN where none rises."""
        span = float(self.time[-1] - self.time[0]) if len(self.time) else 0.0
        return (len(self.time) - 1) / span if span > 0 else float("nan")


@dataclass(frozen=True)
class ChannelStatistics:
    """One channel over one episode."""

    stream: str
    name: str
    unit: str
    count: int
    minimum: float
    low: float
    """First percentile."""
    median: float
    high: float
    """99th percentile."""
    maximum: float
    mean: float
    std: float


@dataclass(frozen=True)
class Contact:
    """A span in which the needle touches something, by the force alone."""

    start_s: float
    stop_s: float


@dataclass(frozen=True)
class PromptToken:
    """One token of the prompt as the model gets it."""

    id: int
    text: str
    kind: Literal["text", "special", "image"]
    view: str | None
    """Of an image token: the camera it comes from."""


@dataclass(frozen=True)
class PromptView:
    """The prompt of one VL row: rendered, and as tokens with the image's expanded."""

    instruction: str
    text: str
    """Before the image tokens are repeated."""
    tokens: tuple[PromptToken, ...]
    image_tokens: Mapping[str, int]
    """By view, in the order of the prompt."""
    special: Mapping[str, int]
    """How often each special token stands there, the image's included, by its name."""
    pixels: tuple[int, int]
    """(height, width) that each image has for the model."""
