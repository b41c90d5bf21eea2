"""The frames that a VL row sees, decoded when they are asked for."""

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.compat.batch import Images
from pipeline.data.episode import ReadEpisode
from pipeline.data.row_range import RowFrames
from pipeline.store import KEY_BYTES


class Frames:
    """Frames by VL row over these episodes, whose rows begin at `vl_start` (episode + 1,)."""

    def __init__(self, episodes: Sequence[ReadEpisode], vl_start: NDArray[np.int64]) -> None:
        views = sorted({view for episode in episodes for view in episode.timeline.frames})
        times = [episode.timeline.frame_times(views) for episode in episodes]
        recordings = [episode.recording for episode in episodes]
        self._vl_start = vl_start
        self._frames = RowFrames(
            recordings, vl_start, np.concatenate(times), views, len(recordings)
        )

    def read(self, rows: NDArray[np.int64]) -> dict[int, Images]:
        """The frames of each of these rows, every row decoded once.

        Raises `RecordingError` naming the file that cannot be decoded.
        """
        return {
            row: frames
            for part in self._frames.ranges(np.unique(rows))
            for row, frames in part.read()
        }

    def first_keys(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Each episode's first row, and a digest (episode, 16) of the frames it sees.

        So that one recording in two formats is known as one, as it is by the keys of a store.
        """
        firsts = self._vl_start[:-1][np.diff(self._vl_start) > 0]
        keys = np.zeros((len(firsts), KEY_BYTES), np.uint8)
        for key, row in zip(keys, firsts, strict=True):
            hasher = hashlib.blake2b(digest_size=KEY_BYTES)
            for view, frame in sorted(self.read(np.array([row]))[int(row)].items()):
                hasher.update(f"{view} {frame.shape}".encode() + frame.tobytes())
            key[:] = np.frombuffer(hasher.digest(), np.uint8)
        return firsts, keys
