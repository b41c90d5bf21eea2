"""Records a run on a robot: the loop hands over copies and goes on, a thread writes them.

The thread encodes images and appends to the logs from which `run_recording` makes a recording. A
recording that fails never stops the robot: `failed` says why, and `finish` raises.
"""

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

from pipeline.base.errors import DiskFull, RecordingError
from pipeline.base.files import FULL
from pipeline.robot.run_recording import (
    READINGS,
    Log,
    begin_part,
    finish_recording,
    frame_path,
    log_types,
)

MOST_IMAGE_BYTES: Final = 2**27
"""Images are dropped when more than this waits to be written."""
MOST_BYTES: Final = 2**28
"""Recording fails when more than this waits to be written, because readings cannot be dropped."""
_FASTEST: Final = {"compression_level": "1", "pred": "up"}


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
            self._tick["answer"] += 1
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


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """A lossless PNG of RGB pixels (height, width, 3)."""
    # Three times as fast as Pillow, and other threads run meanwhile.
    context = av.CodecContext.create("png", "w")
    context.height, context.width = image.shape[:2]
    context.pix_fmt, context.framerate, context.options = "rgb24", Fraction(1), _FASTEST
    frame = av.VideoFrame.from_ndarray(image, format="rgb24")
    return b"".join(map(bytes, [*context.encode(frame), *context.encode(None)]))


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
