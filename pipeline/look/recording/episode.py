"""One recording with every part that can be read, and an issue for every part that cannot.

All times are float64 seconds on the recording's own clock; pictures and tables subtract
`LoadedRecording.zero`.
"""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.config import DataParams
from pipeline.base.errors import Issue, RecordingError, Severity
from pipeline.data import CameraStream, RecordedAction, Recording, Stream
from pipeline.data.timeline import ActionRotation, Timeline, build_timeline
from pipeline.look.page.blocks import Picture

# What reading a damaged recording raises.
BROKEN = (RecordingError, OSError)


@dataclass(frozen=True)
class LoadedRecording:
    """One recording with every part that could be read.

    A part that could not be read is None, or absent from `cameras`, and an issue of kind
    `unreadable` says why. `action` is as recorded, `timeline.action` is at the ticks; `zero` is the
    first instant of all clocks; `action_rotation` is how `timeline` derived actions from poses.
    """

    recording: Recording
    cameras: Mapping[str, CameraStream]
    sensor: Stream | None
    state: Stream | None
    action: RecordedAction | None
    poses: Stream | None = None
    timeline: Timeline | None = None
    issues: tuple[Issue, ...] = ()
    zero: float = 0.0
    instruction: str | None = None
    action_rotation: ActionRotation = "rotvec"

    @property
    def streams(self) -> dict[str, Stream]:
        """The streams that could be read, by name: sensor, state, poses, action."""
        streams = {name: getattr(self, name) for name in ("sensor", "state", "poses", "action")}
        return {name: stream for name, stream in streams.items() if stream is not None}

    @property
    def clocks(self) -> dict[str, NDArray[np.float64]]:
        """The times of every camera and stream, by name: `view View1`, …, `sensor`, `state`, …"""
        cameras = {f"view {view}": camera.time for view, camera in self.cameras.items()}
        return cameras | {name: stream.time for name, stream in self.streams.items()}

    @property
    def shown(self) -> dict[str, Stream]:
        """The streams that a page shows, by name.

        The action is that of the ticks, or the recorded one if there are no ticks; poses that are
        columns of the state are left out.
        """
        streams, line = self.streams, self.timeline
        if {"poses", "state"} <= streams.keys():
            poses, state = (streams[name].channels.names for name in ("poses", "state"))
            if set(poses) <= set(state):
                del streams["poses"]
        if line is not None:
            streams["action"] = Stream(line.action_channels, line.time, line.action)
        return streams

    @property
    def duration_s(self) -> float:
        """From the first to the last instant of all clocks; 0 where nothing could be read."""
        last = max((float(time[-1]) for time in self.clocks.values()), default=self.zero)
        return last - self.zero

    def issue(
        self, kind: str, stream: str, message: str, *span: float, severity: Severity = "warning"
    ) -> Issue:
        """An issue of this episode; `span` is its start and stop on the clock, if it has a place.

        The issue's times are seconds since `zero`, as a page counts them.
        """
        start_s, stop_s = (at - self.zero for at in span) if span else (None, None)
        return Issue(
            severity=severity, kind=kind, message=message, start_s=start_s, stop_s=stop_s,
            source=self.recording.source, episode=self.recording.id, stream=stream,
        )  # fmt: skip


# Makes a picture of an episode from a name, a caption and the function that draws it.
Draw = Callable[[str, str, Callable[[LoadedRecording], Figure]], Picture]


def view_episode(
    recording: Recording, data: DataParams, rotation: ActionRotation
) -> LoadedRecording:
    """Every part of this recording that can be read, and its ticks under `data`.

    No frame is decoded. A part that cannot be read becomes an issue `unreadable`, streams that
    leave no tick an issue `no ticks`; both are errors. A broken recording raises nothing. Raises
    `ConfigError` where poses need `data.action_hz`.
    """
    broken: dict[str, str] = {}

    def attempt(part: str) -> Any:
        try:
            read = getattr(recording, part)
            return read() if callable(read) else read
        except BROKEN as error:
            broken[part] = str(error)
            return None

    names = ("cameras", "sensor", "state", "action", "instruction")
    parts = {name: attempt(name) for name in names}
    parts["cameras"] = parts["cameras"] or {}
    # Poses are mostly columns of the state: then a broken state must be one issue, not two.
    parts["poses"] = None if "state" in broken else attempt("poses")
    view = LoadedRecording(recording, **parts, action_rotation=rotation)
    # One broken file breaks every stream in it: its message must be there once.
    issues = [
        view.issue(
            "unreadable", ", ".join(s for s in broken if broken[s] == message), message,
            severity="error",
        )
        for message in dict.fromkeys(broken.values())
    ]  # fmt: skip
    if view.action is not None or view.poses is not None or not {"action", "state"} & {*broken}:
        try:
            view = replace(view, timeline=_timeline(view, data))
        except RecordingError as error:
            issues.append(view.issue("no ticks", "ticks", str(error), severity="error"))
    zero = min((float(time[0]) for time in view.clocks.values()), default=0.0)
    return replace(view, issues=tuple(issues), zero=zero)


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Start and stop of each run of set flags.

    If flag i is about entries i and i + 1, these are a run's first and last entry.
    """
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)
    return [(int(start), int(stop)) for start, stop in edges]


def _timeline(view: LoadedRecording, data: DataParams) -> Timeline:
    # The parts that were read replace the methods that would read them again.
    read = copy(view.recording)
    read.cameras, read.poses, read.action = (
        partial(getattr, view, name) for name in ("cameras", "poses", "action")
    )
    reuse, rotation = data.vlm_reuse_count, view.action_rotation
    return build_timeline(read, data.action_hz, reuse, rotation, view.state, view.sensor)
