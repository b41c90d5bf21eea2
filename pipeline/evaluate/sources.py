"""What an evaluation was made of, for its page: the training's curves, the recordings' frames.

A store holds no frames. It holds the path and file digests of each episode's recording, and the
capture times of each VL row's frames.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.border import Border
from pipeline.base.digests import file_digest
from pipeline.base.errors import ConfigError, RecordingError
from pipeline.data import Recording, content_digest, open_recording
from pipeline.data.episode import RowRange
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.store import Episode, FeatureStore
from pipeline.train.batches import Ticks, evenly

_CURVES = Border(ConfigError, "Train again where curves are wanted.")


@dataclass(frozen=True)
class TrainingCurve:
    """One metric over the steps of a training, both (point,)."""

    step: NDArray[np.int64]
    value: NDArray[np.float64]


@dataclass(frozen=True)
class TrainingCurves:
    """The curves that a training logged, or why there are none."""

    curves: Mapping[str, TrainingCurve]
    """By name: `train/loss`, `val/error`, `lr`, …"""
    absence: str = ""
    """If there are none, one sentence that names the path."""


def read_curves(checkpoint: PolicyCheckpoint) -> TrainingCurves:
    """The curves of a checkpoint's training, where its logs still have them."""
    folder = checkpoint.params.logs / "plots" / "metrics"
    files = sorted(folder.rglob("*.tsv"))
    try:
        read = {file.relative_to(folder).with_suffix("").as_posix(): _read(file) for file in files}
    except ValueError as error:
        absence = f"No training curves: those in {folder} cannot be read ({error})."
        return TrainingCurves({}, absence)
    curves = {name: curve for name, curve in read.items() if len(curve.step)}
    if not curves:
        return TrainingCurves({}, f"No training curves: there are none in {folder} any more.")
    if _of_another(curves, checkpoint):
        return TrainingCurves({}, f"No training curves: those in {folder} are of another training.")
    return TrainingCurves(curves)


def _of_another(curves: Mapping[str, TrainingCurve], checkpoint: PolicyCheckpoint) -> bool:
    """Whether another training wrote the logs: they lack the checkpoint's step or its error."""
    if max(int(curve.step[-1]) for curve in curves.values()) < checkpoint.step:
        return True
    error, curve = checkpoint.metrics.get("val/error"), curves.get("val/error")
    if error is None or curve is None:
        return False
    return not np.isclose(curve.value[curve.step == checkpoint.step], error, rtol=1e-4).any()


def _read(file: Path) -> TrainingCurve:
    """The columns `step` and value below a line of heads; `ValueError` on anything else."""
    lines = _CURVES.read_bytes(file).decode().splitlines()
    _, *rows = (line.split("\t") for line in lines)
    steps = np.array([int(step) for step, _ in rows], np.int64)
    return TrainingCurve(steps, np.array([float(value) for _, value in rows], np.float64))


Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class EpisodeFrames:
    """Frames of one episode, or why there are none."""

    frames: Mapping[str, Sequence[Frame]]
    """By view, one for each requested VL row: (height, width, 3), RGB."""
    absence: str = ""
    """If there are no frames, one sentence that names the path."""


def shown_ticks(store: FeatureStore, ticks: Ticks, count: int) -> Ticks:
    """At most `count` of these ticks of one episode, evenly spread.

    If there are ticks at which a VL row begins, only these are taken: their frames are the newest.
    """
    rows = store.array("tick/vl_row")[ticks]
    before = store.array("tick/vl_row")[np.maximum(ticks - 1, 0)]
    fresh = ticks[(rows != before) | (ticks == 0)]
    return evenly(fresh if len(fresh) else ticks, count)


def read_episode_frames(
    store: FeatureStore,
    episode: Episode,
    vl_rows: Sequence[int],
    root: Path,
    digest_of: Callable[[Path], str] = file_digest,
) -> EpisodeFrames:
    """The frames of these store-global VL rows of one episode, ascending.

    Relative paths in the store are under `root`. A recording gives no frame if the digests of its
    files have changed. For its digest each file is read whole, unless `digest_of` remembers it.
    """
    path = root / episode.path
    if not path.is_dir():
        return EpisodeFrames({}, f"No frames: there is no recording at {path} any more.")
    try:
        recording = _open_recording(store, episode, path, digest_of)
        if recording is None:
            return EpisodeFrames(
                {}, f"No frames: the recording at {path} changed since the store was made from it."
            )
        rows = np.asarray(vl_rows, np.int64)
        times = store.array("vl/frame_time")[rows]
        shown = RowRange.of(recording, recording.cameras(), rows, times, store.spec["views"])
        frames = [frames for _, frames in shown.read()]
        return EpisodeFrames({view: [by_view[view] for by_view in frames] for view in shown.frames})
    except (RecordingError, OSError) as error:
        reason = " ".join(str(error).split())
        return EpisodeFrames({}, f"No frames: the recording at {path} cannot be read ({reason}).")


def _open_recording(
    store: FeatureStore, episode: Episode, path: Path, digest_of: Callable[[Path], str]
) -> Recording | None:
    """The episode's recording, with all views or those of the store; None where it has changed."""
    for views in (None, store.spec["views"]):
        recording = open_recording(path, episode.format, episode.id, views)
        if content_digest(recording, digest_of) == episode.content:
            return recording
    return None
