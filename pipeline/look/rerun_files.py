"""Episodes of recordings and of stores as Rerun files, in which one can scrub through time.

A file (`.rrd`) has the cameras, the streams, the actions at the ticks and the age of the features
on one timeline, `time`, in seconds since the first instant of the episode. Of a store it also has
the cosine similarity of each VL row with the row before. Open it with `rerun FILE`, or in any
viewer of Rerun 0.23 or later (rerun.io).
"""

import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from pipeline.base.arrays import widen
from pipeline.base.config import Params
from pipeline.base.errors import ConfigError, RecordingError
from pipeline.base.files import fresh
from pipeline.data.timeline import choose_action_rotation
from pipeline.look.recording.episode import LoadedRecording, view_episode
from pipeline.look.subject import Subject
from pipeline.store import Episode, FeatureStore
from pipeline.store.schema import FEATURES

_MOST_CURVES = 64
"""A stream of more channels is shown as its first channel and an image of the others."""
_SCAN_HZ = 10.0
"""Images of a wide stream a second, each of the readings since the one before."""
_JPEG_QUALITY = 85


def write_episodes(subject: Subject, params: Params) -> list[Path]:
    """A file for each of `inspect.episodes` episodes, evenly spread; returns their paths.

    Raises `ConfigError` where Rerun is not installed, and what opening the subject raises.
    """
    count, folder = params.inspect.episodes, subject.folder
    if subject.store is not None:
        store = FeatureStore.open(subject.store)
        chosen = [store.episodes[at] for at in _spread(len(store.episodes), count)]
        return [
            _write_stored(folder / _file_name(episode.source, episode.id), store, episode)
            for episode in _shown(chosen)
        ]
    recordings = subject.recordings(params.data.views).recordings
    rotation = choose_action_rotation(params.data.action_rotation, recordings)
    chosen = [recordings[at] for at in _spread(len(recordings), count)]
    return [
        _write_recorded(
            folder / _file_name(recording.source, recording.id),
            view_episode(recording, params.data, rotation),
        )
        for recording in _shown(chosen)
    ]


def _spread(total: int, count: int) -> list[int]:
    return np.linspace(0, total - 1, min(total, count)).round().astype(int).tolist()


def _shown(chosen: Sequence[Any]) -> "tqdm[Any]":
    return tqdm(chosen, "rerun", unit="episode", disable=None)


def _file_name(source: str, episode: str) -> str:
    return re.sub(r"[^\w.-]+", "_", f"{source}_{episode}") + ".rrd"


def _write_recorded(path: Path, view: LoadedRecording) -> Path:
    """The file of a recording; a part that cannot be read is left out."""
    log = _Log(path, view.recording.id, view.zero)
    for name, stream in view.shown.items():
        log.stream(name, stream.channels.names, stream.time, stream.values)
    for name, camera in view.cameras.items():
        try:
            log.images(f"views/{name}", camera.time, camera.read(range(len(camera.time))))
        except (RecordingError, OSError) as error:
            log.text(f"views/{name}", str(error))
    if (line := view.timeline) is not None and line.frame_time:
        newest = np.max(list(line.frame_time.values()), axis=0)
        log.curves("features/age_s", ["age [s]"], line.time, line.time - newest[line.vl_row])
    return log.close()


def _write_stored(path: Path, store: FeatureStore, episode: Episode) -> Path:
    """The file of an episode of a store, which has no frames."""
    time = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    log = _Log(path, episode.id, float(time[0]))
    action = store.array("tick/action")[episode.ticks.start : episode.ticks.stop]
    log.stream("action", store.streams["action"]["names"], time, action)
    for name, readings in (("sensor", episode.readings), ("state", episode.states)):
        if readings:
            part = slice(readings.start, readings.stop)
            values = store.array(f"{name}/values")[part].astype(np.float32)
            names = store.streams[name]["names"]
            log.stream(name, names, store.array(f"{name}/time")[part], values)
    rows = slice(episode.vl_rows.start, episode.vl_rows.stop)
    age_s = store.feature_age(np.arange(episode.ticks.start, episode.ticks.stop))
    log.curves("features/age_s", ["age [s]"], time, age_s)
    features = widen(store.array(FEATURES)[rows]).reshape(len(episode.vl_rows), -1)
    unit = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)
    alike = np.concatenate([[1.0], (unit[1:] * unit[:-1]).sum(axis=1)])
    log.curves("features/similarity", ["to the row before"], store.array("vl/time")[rows], alike)
    return log.close()


class _Log:
    """One Rerun file; times are in s on the episode's clock, which begins at `zero`."""

    def __init__(self, path: Path, name: str, zero: float) -> None:
        try:
            import rerun  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ConfigError(
                "inspect.rerun: Rerun is not installed: pip install 'vla-feature-cache[rerun]'"
            ) from error
        self._rerun: Any = rerun
        self._path, self._zero = path, zero
        path.parent.mkdir(parents=True, exist_ok=True)
        self._recording: Any = rerun.RecordingStream("vla_feature_cache", recording_id=name)
        self._recording.save(fresh(path))

    def stream(
        self,
        name: str,
        channels: Sequence[str],
        time: NDArray[np.float64],
        values: NDArray[np.float32],
    ) -> None:
        """Curves of a stream (reading, channel); a wide one has a curve, and images of the rest."""
        if len(channels) <= _MOST_CURVES:
            self.curves(name, channels, time, values)
            return
        self.curves(f"{name}/{channels[0]}", channels[:1], time, values[:, 0])
        low, high = np.nanpercentile(values[:, 1:], [1, 99])
        scaled = np.nan_to_num(np.clip((values[:, 1:] - low) / max(high - low, 1e-12), 0, 1))
        begun = np.searchsorted(time, np.arange(time[0], time[-1], 1 / _SCAN_HZ))
        edges = np.unique([*begun[1:], len(time)])  # no image without a reading
        spans = list(zip([0, *edges[:-1]], edges, strict=True))
        images = ((255 * scaled[start:stop]).astype(np.uint8) for start, stop in spans)
        self.images(f"{name}/image", time[edges - 1], images)

    def curves(
        self, place: str, names: Sequence[str], time: NDArray[np.float64], values: NDArray[Any]
    ) -> None:
        """One curve a channel; `values` are (reading,) or (reading, channel)."""
        rerun = self._rerun
        columns = rerun.Scalars.columns(scalars=np.asarray(values, np.float64).ravel())
        if values.ndim == 2:
            columns = columns.partition([values.shape[1]] * len(values))
        self._recording.log(place, rerun.SeriesLines(names=list(names)), static=True)
        clock = rerun.TimeColumn("time", duration=time - self._zero)
        self._recording.send_columns(place, indexes=[clock], columns=columns)

    def images(
        self, place: str, time: NDArray[np.float64], frames: Iterator[NDArray[np.uint8]]
    ) -> None:
        """Frames as JPEGs, each at its time; one is in memory at a time."""
        for at, frame in zip(time, frames, strict=True):
            encoded = io.BytesIO()
            Image.fromarray(frame).save(encoded, "JPEG", quality=_JPEG_QUALITY)
            self._recording.set_time("time", duration=float(at - self._zero))
            picture = self._rerun.EncodedImage(contents=encoded.getvalue(), media_type="image/jpeg")
            self._recording.log(place, picture)

    def text(self, place: str, message: str) -> None:
        """A message in place of what cannot be shown."""
        self._recording.log(place, self._rerun.TextLog(message, level="ERROR"), static=True)

    def close(self) -> Path:
        """Finish the file; returns its path."""
        self._recording.flush()
        self._recording.disconnect()
        return self._path
