"""The frames that a VL row sees, decoded when they are asked for."""

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.compat.batch import Images
from pipeline.compat.streams import ReadEpisode
from pipeline.data import CameraStream
from pipeline.store import KEY_BYTES


class Frames:
    """Frames by VL row over these episodes, whose rows begin at `vl_start` (episode + 1,)."""

    def __init__(self, episodes: Sequence[ReadEpisode], vl_start: NDArray[np.int64]) -> None:
        self._vl_start = vl_start
        self._shown = [dict(one.timeline.frames) for one in episodes]
        # Opened once: listing an episode's frames costs time.
        self._cameras: list[dict[str, CameraStream]] = [
            dict(one.recording.cameras()) for one in episodes
        ]

    def read(self, rows: NDArray[np.int64]) -> dict[int, Images]:
        """The frames of each of these rows, every row decoded once.

        Raises `RecordingError` naming the file that cannot be decoded.
        """
        found: dict[int, Images] = {}
        distinct = np.unique(rows)
        episodes = np.searchsorted(self._vl_start, distinct, side="right") - 1
        for episode in np.unique(episodes).tolist():
            of_episode = distinct[episodes == episode]
            inside = of_episode - self._vl_start[episode]
            readers = {
                view: camera.read(self._shown[episode][view][inside].tolist())
                for view, camera in self._cameras[episode].items()
            }
            for row in of_episode.tolist():
                found[row] = {view: next(reader) for view, reader in readers.items()}
        return found

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
