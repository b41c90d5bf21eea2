"""VL rows and their frames, decoded on demand."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import RecordingError
from pipeline.data.recording import CameraStream, Recording
from pipeline.data.timeline import last_at

Frames = dict[str, NDArray[np.uint8]]
"""View -> (height, width, 3) RGB."""


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
    ) -> Self:
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
