"""VL rows of one episode and the frames that they show."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.data.recording import CameraStream, Recording
from pipeline.data.timeline import last_at


@dataclass(frozen=True)
class RowRange:
    """Rows of one episode, ascending, and the frame of each view for each."""

    recording: Recording
    cameras: Mapping[str, CameraStream]
    """Opened once an episode: listing its frames costs time."""
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
        """Which frames rows show follows from the capture times (row, view) that a store has."""
        frames = {
            view: last_at(cameras[view].time, frame_time[:, column])
            for column, view in enumerate(views)
            if np.isfinite(frame_time[0, column])
        }
        return cls(recording, cameras, rows, frames)

    def read(self) -> Iterator[tuple[int, dict[str, NDArray[np.uint8]]]]:
        """Each row and its frames by view, decoded one row at a time."""
        readers = {
            view: self.cameras[view].read(frames.tolist()) for view, frames in self.frames.items()
        }
        for row in self.rows.tolist():
            yield row, {view: next(reader) for view, reader in readers.items()}
