"""What a store takes of recordings: streams, ticks and channels, and frames for its VL rows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.documents import named
from pipeline.base.errors import RecordingError, StoreMismatch
from pipeline.data.recording import CameraStream, Channels, Recording, Stream
from pipeline.data.timeline import ActionRotation, Timeline, build_timeline, last_at

Frames = dict[str, NDArray[np.uint8]]
"""View -> (height, width, 3) RGB."""
_NO_CHANNELS = Channels((), ())


@dataclass(frozen=True)
class Embodiment:
    """Channels of action, sensor and state; no channels where a stream is absent."""

    action: Channels
    action_kind: str
    sensor: Channels = _NO_CHANNELS
    state: Channels = _NO_CHANNELS

    @classmethod
    def of(
        cls, action: Channels, action_kind: str, sensor: Stream | None, state: Stream | None
    ) -> "Embodiment":
        """The embodiment of a recording with these streams."""
        streams = {"sensor": sensor, "state": state}
        channels = {name: stream.channels for name, stream in streams.items() if stream is not None}
        return cls(action, action_kind, **channels)

    def document(self) -> dict[str, dict[str, Any]]:
        """Names and units of each stream and the kind of action, as a store keeps them."""
        document: dict[str, dict[str, Any]] = {}
        for stream in ("action", "sensor", "state"):
            channels: Channels = getattr(self, stream)
            document[stream] = {"names": list(channels.names), "units": list(channels.units)}
        document["action"]["kind"] = self.action_kind
        return document


@dataclass(frozen=True)
class ReadEpisode:
    """A recording, its ticks and its complete streams; a stream is None where it has none."""

    recording: Recording
    timeline: Timeline
    sensor: Stream | None
    state: Stream | None

    @property
    def embodiment(self) -> Embodiment:
        """Names and units of its channels."""
        line = self.timeline
        return Embodiment.of(line.action_channels, line.action_kind, self.sensor, self.state)

    @property
    def readings(self) -> int:
        """Readings of the sensor."""
        return len(self.sensor.time) if self.sensor else 0

    @property
    def states(self) -> int:
        """Readings of the robot state."""
        return len(self.state.time) if self.state else 0


def read_episode(
    recording: Recording,
    action_hz: float | None,
    vlm_reuse_count: int,
    action_rotation: ActionRotation,
) -> ReadEpisode:
    """Every stream of a recording and the ticks over it; no frame is decoded.

    Raises `RecordingError` where the recording cannot be read or has no tick, and `ConfigError`
    where actions are derived from poses and `action_hz` is None.
    """
    state, sensor = recording.state(), recording.sensor()
    line = build_timeline(recording, action_hz, vlm_reuse_count, action_rotation, state, sensor)
    return ReadEpisode(recording, line, sensor, state)


def common_embodiment(
    recordings: Sequence[tuple[Recording, Embodiment]], of: str, remedy: str
) -> Embodiment:
    """The embodiment that all these recordings share; a recording may lack a stream.

    Raises `StoreMismatch`, which names two recordings that differ in channels, units or kind of
    action, and ends with the `remedy`; `of` is the word for what they share, such as a store.
    """
    common: dict[str, Channels] = {}
    for stream in ("action", "state", "sensor"):
        having = [(recording, _kinds(own, stream)) for recording, own in recordings]
        having = [(recording, kinds) for recording, kinds in having if kinds[0].names]
        for recording, kinds in having[1:]:
            first, expected = having[0]
            if kinds != expected:
                raise StoreMismatch(
                    f"one {of} holds one embodiment, but the {stream} of source {first.source!r} "
                    f"({first.path}) is {_shown(*expected)} and that of source "
                    f"{recording.source!r} ({recording.path}) is {_shown(*kinds)}. {remedy}"
                )
        common[stream] = having[0][1][0] if having else _NO_CHANNELS
    return Embodiment(action_kind=recordings[0][1].action_kind, **common)


def _kinds(embodiment: Embodiment, stream: str) -> tuple[Channels, str]:
    return getattr(embodiment, stream), embodiment.action_kind if stream == "action" else ""


def _shown(channels: Channels, kind: str) -> str:
    pairs = zip(channels.names, channels.units, strict=True)
    names = [named(f"{name} ({unit})" if unit else name) for name, unit in pairs]
    listed = ", ".join(names if len(names) <= 12 else [*names[:4], "…", names[-1]])
    return f"{len(names)} {kind} channels [{listed}]".replace("  ", " ")


@dataclass(frozen=True)
class RowRange:
    """Rows of one episode, ascending, and for each view the index of the frame of each row."""

    recording: Recording
    cameras: Mapping[str, CameraStream]
    """The cameras of the whole episode, shared because it takes time to list frames."""
    rows: NDArray[np.int64]
    """Store-global VL rows."""
    frames: Mapping[str, NDArray[np.int64]]

    @classmethod
    def of(
        cls,
        recording: Recording,
        cameras: Mapping[str, CameraStream],
        rows: NDArray[np.int64],
        frame_time: NDArray[np.float64],
        views: Sequence[str],
    ) -> "RowRange":
        """The frames of rows with these capture times (row, view) s from a store.

        Raises `RecordingError` where the recording has no frames at these times.
        """
        frames: dict[str, NDArray[np.int64]] = {}
        for column, view in enumerate(views):
            times = frame_time[:, column]
            if not np.isfinite(times).all():  # the episode lacks the view
                continue
            clock = cameras[view].time if view in cameras else np.zeros(0)
            frames[view] = last_at(clock, times)
            # A store holds the cameras' own times, so a different time means another frame.
            if (frames[view] < 0).any() or not np.array_equal(clock[frames[view]], times):
                raise RecordingError(
                    f"{recording.path}: {view} has no frames at the times that the store has"
                )
        return cls(recording, cameras, rows, frames)

    def read(self) -> Iterator[tuple[int, Frames]]:
        """Each row and its frames by view, decoded one row at a time."""
        readers = {
            view: self.cameras[view].read(frames.tolist()) for view, frames in self.frames.items()
        }
        for row in self.rows.tolist():
            yield row, {view: next(reader) for view, reader in readers.items()}


class RowFrames:
    """The recordings of a store's VL rows, and the capture times of their frames."""

    def __init__(
        self,
        recordings: Sequence[Recording] | Mapping[int, Recording],
        vl_start: NDArray[np.int64],
        frame_time: NDArray[np.float64],
        views: Sequence[str],
        open_episodes: int = 8,
    ) -> None:
        """`vl_start` (episode + 1,) is each episode's first row, `frame_time` (row, view) in s.

        The cameras of `open_episodes` episodes are kept open.
        """
        self.vl_start = vl_start
        self.frame_time = frame_time
        self._recordings = recordings
        self._views = views
        self._cameras = lru_cache(open_episodes)(lambda episode: recordings[episode].cameras())

    def ranges(self, rows: NDArray[np.int64], most: int | None = None) -> Iterator[RowRange]:
        """These rows, ascending, in ranges of one episode and at most `most` rows each.

        Raises what `RowRange.of` and the recordings' `cameras` raise.
        """
        for episode, inside in by_episode(rows, self.vl_start):
            recording, cameras = self._recordings[episode], self._cameras(episode)
            for part in np.split(inside, range(most, len(inside), most) if most else []):
                yield RowRange.of(recording, cameras, part, self.frame_time[part], self._views)


def by_episode(
    rows: NDArray[np.int64], vl_start: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each episode of these rows, ascending, and its rows."""
    episode = np.searchsorted(vl_start, rows, side="right") - 1
    for index in np.unique(episode).tolist():
        yield index, rows[episode == index]
