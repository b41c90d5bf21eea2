"""From the logs of a run on a robot to a recording, a LeRobot data set of one episode.

While a robot runs, its recorder appends to plain logs in `run_000003.part`: `<log>.bin` with rows
of `log_types`, and a PNG for each frame. A kill can only cut off their end. `finish_recording`
turns them into `run_000003`, a LeRobot v3.0 data set with this project's sidecars:

    data, meta             a row for each tick with an action, images without loss; a row for every
                           tick, without `action`, where the whole run has none
    state, sensor          every reading, at its own rate
    frames                 when each row's images were captured
    features               the features behind each action: `row_key` and age
    run.json               the policy's metadata, the settings, and why the run ended

Times are seconds since the first row; `run.json` has the first row's time on the robot's clock.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from pipeline.base.arrays import non_finite
from pipeline.base.border import Document, Text
from pipeline.base.errors import RecordingError
from pipeline.base.files import (
    OutputKind,
    begin_folder,
    remove_folder,
    sync,
    unmark,
    write_document,
)
from pipeline.data.lerobot import ACTION, STATE
from pipeline.data.lerobot_writer import write_sidecar, write_v30
from pipeline.data.recording import RECORDINGS

RUN: Final = "run.json"
READINGS: Final = ("state", "sensor")
_RUN: Final = OutputKind("a run on a robot", lambda folder: (folder / RUN).is_file())

Log = NDArray[Any]


class RunDocument(Document):
    """The content of `run.json`; fields that are not declared here are kept, too."""

    model_config = ConfigDict(extra="allow")

    metadata: dict[str, Any]
    """Metadata of the policy."""
    instruction: Text = ""


def log_types(metadata: Mapping[str, Any]) -> "dict[str, np.dtype[Any]]":
    """The row type of each log by name, for a policy with this metadata.

    `tick` has its `time` (s, the robot's clock), whether an action was sent (`acted`), the state
    readings so far (`states`), the number of the newest `frame` of each view (-1: none), and the
    newest answer's number (`answer`, 0: none), `key` and `age_s`.
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
    rows["tick"] += [("frame", "i4", (views,)), ("answer", "i8"), ("key", "u1", (16,))]
    rows["tick"] += [("age_s", "f4")]
    rows["frame"] = [("time", "f8"), ("shape", "i4", (3,))]
    return {name: np.dtype(fields) for name, fields in rows.items()}


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
    left_out = _write_readings(root, run, logs, float(rows["time"][0]))
    counts = {"ticks": len(logs["tick"]), "rows": len(rows), "readings_left_out": left_out}
    began = run.model_dump(exclude_unset=True)
    write_document(root / RUN, {**began, **end, **counts, "start_s": float(rows["time"][0])})
    _write_rows(root, part, run, logs, rows)
    unmark(root)
    for file in root.rglob("*"):
        sync(file)
    target = part.with_suffix("")
    root.rename(target)
    remove_folder(part, _RUN)
    return target


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


def _write_readings(
    root: Path, run: RunDocument, logs: Mapping[str, Log], start_s: float
) -> dict[str, int]:
    """Write the sidecars of readings; returns how many NaN or disordered ones each leaves out."""
    left_out: dict[str, int] = {}
    for name in READINGS:
        if len(log := logs[name]):
            times = log["time"]
            backwards = times < np.fmax.accumulate(times)  # such a clock stops the robot
            bad = np.flatnonzero(
                non_finite(log["values"]).any(axis=1) | ~np.isfinite(times) | backwards
            )
            left_out[name] = len(bad)
            kept = np.delete(log, bad) if len(bad) else log
            channels = run.metadata["streams"][name]
            named = {key: np.array(channels[key], str) for key in ("names", "units")}
            readings = {"timestamps": kept["time"] - start_s, "values": kept["values"]}
            write_sidecar(root, name, readings | named)
    return left_out


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
    used = {name: rows[name] for name in ("answer", "key", "age_s")}
    write_sidecar(root, "features", used | {"feature_spec_digest": digest})
    write_v30(root, columns, images, features, run.instruction, metadata["action_hz"])
