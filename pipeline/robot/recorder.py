"""Records a run on a robot as a LeRobot data set of one episode.

While the robot runs, the loop hands over copies and goes on, and a thread writes them to
`run_000003.part`: `<log>.bin` with rows of `log_types`, and a PNG for each frame. A kill can only
cut off their end. A recording that fails never stops the robot: `failed` says why, and `finish`
raises. `finish` and `recover` turn the logs into `run_000003`, a LeRobot v3.0 data set with this
project's sidecars:

    data, meta             a row for each tick with an action, images without loss; a row for every
                           tick, without `action`, where the whole run has none
    state, sensor          every reading, at its own rate
    frames                 when each row's images were captured
    features               the features behind each action: `row_key` and age
    run.json               the policy's metadata, the settings, and why the run ended

Times are seconds since the first row; `run.json` has the first row's time on the robot's clock.
"""

import re
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final

import av
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict

from pipeline.base.arrays import non_finite
from pipeline.base.documents import Document, Text
from pipeline.base.errors import DiskFull, RecordingError
from pipeline.base.files import (
    FULL,
    OutputKind,
    begin_folder,
    remove_folder,
    sync,
    unmark,
    write_document,
)
from pipeline.data.lerobot import ACTION, STATE
from pipeline.data.lerobot_writer import LeRobotRows, write_data_set, write_sidecar
from pipeline.data.recording import RECORDINGS

RUN: Final = "run.json"
READINGS: Final = ("state", "sensor")
_RUN: Final = OutputKind("a run on a robot", lambda folder: (folder / RUN).is_file())

Log = NDArray[Any]
MOST_IMAGE_BYTES: Final = 2**27
"""Images are dropped when more than this waits to be written."""
MOST_BYTES: Final = 2**28
"""Recording fails when more than this waits to be written, because readings cannot be dropped."""
_FASTEST: Final = {"compression_level": "1", "pred": "up"}


class RunDocument(Document):
    """The content of `run.json`; fields that are not declared here are kept, too."""

    model_config = ConfigDict(extra="allow")

    metadata: dict[str, Any]
    """Metadata of the policy."""
    instruction: Text = ""


def log_types(metadata: Mapping[str, Any]) -> "dict[str, np.dtype[Any]]":
    """The row type of each log by name, for a policy with this metadata.

    `tick` has its `time` (s, the robot's clock), whether an action was sent (`acted`), the state
    readings so far (`states`), the number of the newest `frame` of each view (-1: none), and `key`
    and `age_s` of the newest answer's features.
    """
    streams = metadata["streams"]
    widths = {name: len(streams.get(name, {}).get("names", ())) for name in READINGS}
    rows: dict[str, list[Any]] = {
        name: [("time", "f8"), ("values", "f4", (width,))]
        for name, width in widths.items()
        if width
    }
    action, views = len(streams["action"]["names"]), len(streams["views"])
    rows["tick"] = [("time", "f8"), ("acted", "?"), ("action", "f4", (action,)), ("states", "i8")]
    rows["tick"] += [("frame", "i4", (views,)), ("key", "u1", (16,)), ("age_s", "f4")]
    rows["frame"] = [("time", "f8"), ("shape", "i4", (3,))]
    return {name: np.dtype(fields) for name, fields in rows.items()}


class RunRecorder:
    """Records one run on a robot, of any embodiment, as `run_NNNNNN` in a folder.

    In each tick the loop calls `frames` and `answer` if there are new ones, then `tick`. It does so
    in the tick that ends a run too, because its readings may be the reason. None of them waits or
    raises. A kill leaves `run_NNNNNN.part`, which `recover` finishes.
    """

    def __init__(
        self,
        folder: str | Path,
        metadata: Mapping[str, Any],
        instruction: str,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        """`metadata` is the policy's, `settings` are the loop's; both are kept as JSON.

        Raises `RecordingError` where the folder cannot be made, `DiskFull` where the disk is full.
        """
        self._types = log_types(metadata)
        self._views = {view: i for i, view in enumerate(metadata["streams"]["views"])}
        document = {"instruction": instruction, "metadata": metadata, "settings": settings or {}}
        self.part = begin_part(Path(folder), document)
        self.dropped_images = 0
        self._error: Exception | None = None
        self._tick = np.zeros(1, self._types["tick"])
        self._tick["time"], self._tick["frame"] = -np.inf, -1
        self._frame_time = dict.fromkeys(self._views, -np.inf)
        self._frames = self._put_bytes = self._written_bytes = 0
        self._queue: SimpleQueue[tuple[Callable[[], None], int] | None] = SimpleQueue()
        self._thread = Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    @property
    def failed(self) -> str | None:
        """Why nothing is recorded any more; None while recording works."""
        return None if self._error is None else f"{type(self._error).__name__}: {self._error}"

    def frames(self, frames: Mapping[str, tuple[float, NDArray[np.uint8]]]) -> None:
        """Record frames for the model: the capture time (s) and RGB image of each view.

        A frame no newer than the last of its view is the same frame. Cameras that the policy does
        not use are ignored; an image that does not fit into the queue is dropped and counted.
        """
        with self._unharmed():
            for view, (time, image) in frames.items():
                if view not in self._views or time <= self._frame_time[view]:
                    continue
                self._frame_time[view] = time
                if self._waiting_bytes + image.nbytes > MOST_IMAGE_BYTES:
                    self.dropped_images += 1
                    continue
                row = np.array([(time, image.shape)], self._types["frame"])
                kept = np.array(image, np.uint8, order="C")
                self._put(partial(self._write_frame, self._frames, kept, row), kept.nbytes)
                self._tick["frame"][0, self._views[view]] = self._frames
                self._frames += 1

    def answer(self, answer: Mapping[str, Any]) -> None:
        """Record the features behind the next actions: `feature_key`, `feature_age_s`."""
        with self._unharmed():
            self._tick["key"] = np.asarray(answer.get("feature_key", 0), np.uint8)
            self._tick["age_s"] = answer.get("feature_age_s", np.nan)

    def tick(self, observed: Mapping[str, Any], action: ArrayLike | None) -> None:
        """Record a tick: its `time`, the readings since the last, and the action that was sent.

        A tick without an action makes no row, but its readings are kept. A recording is one
        episode: if `reset` begins another, it fails and keeps only the first.
        """
        with self._unharmed():
            if observed.get("reset") and self._tick["time"] > -np.inf:
                raise RecordingError("another episode begins: give each a recorder of its own")
            for name in READINGS:
                time = np.asarray(observed.get(f"{name}_time", ()))
                if name in self._types and len(time):
                    readings = np.empty(len(time), self._types[name])
                    readings["time"], readings["values"] = time, observed[name]
                    self._append(name, readings)
                    self._tick["states"] += len(time) if name == "state" else 0
            self._tick["time"] = observed["time"]
            self._tick["acted"] = action is not None
            self._tick["action"] = 0 if action is None else action
            self._append("tick", self._tick.copy())

    def finish(self, reason: str, timings: Mapping[str, Any] | None = None) -> Path:
        """Finish the recording and return its folder, a LeRobot data set.

        `run.json` says why the run ended. Raises `DiskFull` or `RecordingError` where it could not
        be written, or nothing was observed; then the `.part` is kept.
        """
        self._queue.put(None)
        self._thread.join()
        if self._error is not None:
            raise _unfinished(self.part, self._error) from self._error
        end = {"reason": reason, "timings": timings or {}, "dropped_images": self.dropped_images}
        return _finished(self.part, end)

    @property
    def _waiting_bytes(self) -> int:
        return self._put_bytes - self._written_bytes

    @contextmanager
    def _unharmed(self) -> Generator[None]:
        """Note an error as the recording's; the loop, whose robot is moving, goes on."""
        try:
            yield
        except Exception as error:
            self._error = self._error or error

    def _append(self, name: str, rows: Log) -> None:
        self._put(partial(self._write_rows, name, rows), rows.nbytes)

    def _put(self, work: Callable[[], None], size: int) -> None:
        if self._error is not None:
            return
        if self._waiting_bytes + size > MOST_BYTES:
            raise RecordingError(
                f"{self._waiting_bytes >> 20} MiB wait to be written: the disk does not keep up"
            )
        self._put_bytes += size
        self._queue.put((work, size))

    def _write(self) -> None:
        """Run in the thread: write in the order of `_put`, until a write fails."""
        whole = True
        for work, size in iter(self._queue.get, None):
            if whole:
                whole = False
                with self._unharmed():
                    work()
                    whole = True
            self._written_bytes += size

    def _write_frame(self, number: int, image: NDArray[np.uint8], row: Log) -> None:
        frame_path(self.part, number).write_bytes(encode_png(image))
        self._write_rows("frame", row)

    def _write_rows(self, name: str, rows: Log) -> None:
        with (self.part / f"{name}.bin").open("ab") as file:
            file.write(rows.tobytes())


def recover(part: str | Path) -> Path:
    """Make the recording of a run that was killed, or whose disk was full; returns its folder.

    Raises as `RunRecorder.finish` does. The run must have ended.
    """
    return _finished(Path(part), {"reason": "recovered: the run did not say how it ended"})


def _finished(part: Path, end: Mapping[str, Any]) -> Path:
    try:
        return finish_recording(part, end)
    except OSError as error:
        raise _unfinished(part, error) from error


def _unfinished(part: Path, error: Exception) -> DiskFull | RecordingError:
    kind = DiskFull if getattr(error, "errno", None) in FULL else RecordingError
    return kind(
        f"{part}: the recording of this run is not finished: {error}. What was recorded until then "
        'is there. Make room, then finish it: python -c "from pipeline.robot.recorder import '
        f"recover; print(recover('{part}'))\", or remove the folder"
    )


def finish_recording(part: Path, end: Mapping[str, Any]) -> Path:
    """Turn a run's logs into its recording and return the folder.

    `end` is added to `run.json`. Until all is written the logs stay, and no folder looks like a
    recording. Raises `RecordingError` if there is no tick, and for any other folder.
    """
    if part.suffix != ".part":
        raise RecordingError(f"{part}: expected what is left of a run, run_NNNNNN.part")
    run = RECORDINGS.read_json(part / RUN, RunDocument)
    logs = dict.fromkeys(READINGS, np.zeros(0))
    logs |= {name: _read(part, name, kind) for name, kind in log_types(run.metadata).items()}
    rows = _rows(logs)
    if not len(rows):
        raise RecordingError(
            f"{part}: expected a tick of the run, found none: the robot was never observed, so "
            f"there is nothing to make a recording of. Look into {RUN}, and remove {part}"
        )
    root = part / ".recording"  # folders that begin with a dot are not searched for recordings
    begin_folder(root, _RUN)
    start_s = float(rows["time"][0])
    _write_readings(root, run, logs, start_s)
    counts = {"ticks": len(logs["tick"]), "rows": len(rows), "start_s": start_s}
    write_document(root / RUN, {**run.model_dump(exclude_unset=True), **end, **counts})
    _write_rows(root, part, run, logs, rows)
    unmark(root)
    for file in root.rglob("*"):
        sync(file)
    target = part.with_suffix("")
    root.rename(target)
    remove_folder(part, _RUN)
    return target


def begin_part(folder: Path, document: Mapping[str, Any]) -> Path:
    """Make the next `run_NNNNNN.part` in `folder`; `RecordingError` where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        runs = (re.match(r"run_(\d+)", path.name) for path in folder.iterdir())
        number = max((int(match[1]) for match in runs if match), default=-1) + 1
        part = folder / f"run_{number:06d}.part"
        (part / "frames").mkdir(parents=True)
    except OSError as error:
        raise RecordingError(
            f"{folder}: runs cannot be recorded there: {error.strerror}. Name another folder"
        ) from None
    write_document(part / RUN, document)
    return part


def frame_path(part: Path, number: int) -> Path:
    """The file of a frame while the run lasts."""
    return part / "frames" / f"{number:06d}.png"


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """A lossless PNG of RGB pixels (height, width, 3)."""
    # Three times as fast as Pillow, and other threads run meanwhile.
    context = av.CodecContext.create("png", "w")
    context.height, context.width = image.shape[:2]
    context.pix_fmt, context.framerate, context.options = "rgb24", Fraction(1), _FASTEST
    frame = av.VideoFrame.from_ndarray(image, format="rgb24")
    return b"".join(map(bytes, [*context.encode(frame), *context.encode(None)]))


def _read(part: Path, name: str, kind: "np.dtype[Any]") -> Log:
    """The complete rows of a log, without one that a kill or a full disk cut off."""
    path = part / f"{name}.bin"
    rows = path.stat().st_size // kind.itemsize if path.exists() else 0
    return np.memmap(path, kind, "r", shape=(rows,)) if rows else np.zeros(0, kind)


def _rows(logs: Mapping[str, Log]) -> Log:
    """The ticks that become rows: those with an action once all streams have begun.

    If the whole run has no action, every tick may be a row. A tick in which the robot's clock stood
    still is left out, because a recording's clock rises.
    """
    ticks = logs["tick"]
    if ticks["acted"].any():
        ticks = ticks[ticks["acted"]]
    ticks = ticks[np.isfinite(ticks["time"])]
    ticks = ticks[np.diff(np.maximum.accumulate(ticks["time"]), prepend=-np.inf) > 0]
    begun = np.column_stack([ticks["frame"] >= 0, ticks["states"] > 0])
    return ticks[begun[:, begun.any(axis=0)].all(axis=1)]


def _write_readings(root: Path, run: RunDocument, logs: Mapping[str, Log], start_s: float) -> None:
    """Write the sidecars of readings, without those that stopped the robot: NaN or disordered."""
    for name in READINGS:
        if len(log := logs[name]):
            times = log["time"]
            backwards = times < np.fmax.accumulate(times)  # such a clock stops the robot
            bad = np.flatnonzero(
                non_finite(log["values"]).any(axis=1) | ~np.isfinite(times) | backwards
            )
            kept = np.delete(log, bad) if len(bad) else log
            channels = run.metadata["streams"][name]
            named = {key: np.array(channels[key], str) for key in ("names", "units")}
            readings = {"timestamps": kept["time"] - start_s, "values": kept["values"]}
            write_sidecar(root, name, readings | named)


def _write_rows(
    root: Path, part: Path, run: RunDocument, logs: Mapping[str, Log], rows: Log
) -> None:
    metadata, start, shown = run.metadata, rows["time"][0], logs["frame"]
    streams: Mapping[str, Any] = metadata["streams"]
    views = dict(zip(streams["views"], rows["frame"].T, strict=True))
    views = {view: number for view, number in views.items() if number[0] >= 0}
    columns: dict[str, NDArray[Any]] = {"timestamp": rows["time"] - start}
    features: dict[str, Mapping[str, Any]] = {}
    if rows["acted"][0]:
        columns[ACTION], features[ACTION] = rows["action"], streams["action"]
    if rows["states"][0]:
        columns[STATE] = logs["state"]["values"][rows["states"] - 1]
        features[STATE] = streams["state"]
    images: dict[str, list[Path]] = {}
    captured: dict[str, NDArray[np.float64]] = {}
    for view, number in views.items():
        key = f"observation.images.{view}"
        images[key] = [frame_path(part, index) for index in number.tolist()]
        features[key] = {"shape": shown["shape"][number[0]].tolist()}
        # A camera may take a frame between the beginning of a tick and the request for the frame.
        came = rows["time"][np.searchsorted(number, number)]
        captured[view] = np.minimum(shown["time"][number], came) - start
    if captured:
        write_sidecar(root, "frames", captured)
    digest = np.array([str(metadata.get("feature_spec_digest", ""))])
    used = {"key": rows["key"], "age_s": rows["age_s"]}
    write_sidecar(root, "features", used | {"feature_spec_digest": digest})
    episode = LeRobotRows(columns, images=images)
    write_data_set(root, [episode], features, run.instruction, metadata["action_hz"])
