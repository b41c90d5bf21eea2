"""Writes LeRobot data sets v3.0, and this project's sidecars beside them, for its own reader.

`meta/info.json` is written last: until then the folder does not look like a recording. `units` and
`kind` of a feature are this project's extension; other readers ignore them.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.data.lerobot_meta import MARKER, sidecar

Columns = Mapping[str, NDArray[Any]]
"""Feature key -> (row,) or (row, channel), with `timestamp` (s since the first row)."""
Features = Mapping[str, Mapping[str, Any]]
"""Feature key -> its entries in `info.json` besides type and shape."""

_DATA: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_CHUNK: Final = 1000
"""Files in a folder."""
_NUMBERING: Final = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_IMAGES_A_GROUP: Final = 64
"""Images in a row group: equal images are stored once per group, and a group is held in memory."""
_DICTIONARY_BYTES: Final = 2**30
_IMAGE: Final = pa.struct(
    [("bytes", pa.dictionary(pa.int32(), pa.binary())), ("path", pa.string())]
)


class LeRobotRows(NamedTuple):
    """The rows of one episode and, by feature key, the frames of each camera."""

    columns: Columns
    films: Mapping[str, NDArray[np.uint8]] = {}
    """(row, height, width, 3) RGB, written as a video."""
    images: Mapping[str, Sequence[Path]] = {}
    """Each row's image file, written unchanged into the rows."""


def write_data_set(
    root: Path,
    episodes: Iterable[LeRobotRows],
    features: Features,
    task: str,
    fps: float,
    robot_type: str | None = None,
    lossless: bool = False,
) -> None:
    """Write a complete data set; reads one episode at a time from the iterable.

    Each episode has its own files, which v3.0 allows; there is at least one episode. With
    `lossless`, films have every pixel as it is, in about ten times the bytes.
    """
    rows: list[dict[str, Any]] = []
    described: dict[str, dict[str, Any]] = {}
    for index, (own, films, images) in enumerate(episodes):
        first = rows[-1]["dataset_to_index"] if rows else 0
        columns = _numbered(own, index, first)
        length = len(columns["timestamp"])
        place = {"chunk_index": index // _CHUNK, "file_index": index % _CHUNK}
        _write_rows(root / _DATA.format(**place), columns, images)
        row = {"episode_index": index, "length": length, "tasks": [task]}
        row |= {"dataset_from_index": first, "dataset_to_index": first + length}
        row |= {f"data/{name}": number for name, number in place.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        for key, film in films.items():
            _write_video(root / _VIDEO.format(video_key=key, **place), film, round(fps), lossless)
            span = {**place, "from_timestamp": 0.0, "to_timestamp": length / fps}
            row |= {f"videos/{key}/{name}": value for name, value in span.items()}
        rows.append(row)
        cameras = {key: _video_feature(film) for key, film in films.items()} | {
            key: {"dtype": "image", "names": ["height", "width", "channel"]} for key in images
        }
        described = _described(columns, cameras, features)
    _write_meta(root, rows, task)
    info = {
        "codebase_version": "v3.0",
        "robot_type": robot_type,
        "total_episodes": len(rows),
        "total_frames": rows[-1]["dataset_to_index"],
        "total_tasks": 1,
        "chunks_size": _CHUNK,
        "fps": int(fps) if float(fps).is_integer() else fps,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": _DATA,
        "video_path": _VIDEO if any(f["dtype"] == "video" for f in described.values()) else None,
        "features": described,
    }
    (root / MARKER).write_text(json.dumps(info, indent=4), encoding="utf-8")


def _write_meta(root: Path, rows: list[dict[str, Any]], task: str) -> None:
    """Write `meta/episodes` and `meta/tasks.parquet`."""
    folder = root / "meta" / "episodes" / "chunk-000"
    folder.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), folder / "file-000.parquet")
    # LeRobot finds tasks by the index that pandas makes from this column.
    column = {"name": "task", "field_name": "task"}
    column |= {"pandas_type": "unicode", "numpy_type": "object"}
    index = {"index_columns": ["task"], "columns": [column], "column_indexes": []}
    pandas = {"pandas": json.dumps(index)}
    tasks = pa.table({"task_index": [0], "task": [task]}, metadata=pandas)
    pq.write_table(tasks, root / "meta" / "tasks.parquet")


def write_sidecar(
    root: Path,
    name: str,
    members: Mapping[str, NDArray[Any]],
    index: int = 0,
    compressed: bool = False,
) -> None:
    """Write an episode's data that have no place in LeRobot."""
    path = sidecar(root, name, index)
    path.parent.mkdir(parents=True, exist_ok=True)
    save = np.savez_compressed if compressed else np.savez
    save(path, allow_pickle=False, **members)


def _numbered(columns: Columns, episode: int, first: int) -> dict[str, NDArray[Any]]:
    """The columns of an episode and, last, LeRobot's columns that number the rows."""
    time = columns["timestamp"]
    numbers = [time, np.arange(len(time)), np.full(len(time), episode)]
    numbers += [first + np.arange(len(time)), np.zeros(len(time), np.int64)]
    own = {name: values for name, values in columns.items() if name != "timestamp"}
    return own | dict(zip(_NUMBERING, numbers, strict=True))


def _described(columns: Columns, cameras: Features, features: Features) -> dict[str, Any]:
    """`features` of `info.json`."""
    numbers: dict[str, dict[str, Any]] = {
        name: {"dtype": str(values.dtype), "shape": [*values.shape[1:]] or [1], "names": None}
        for name, values in columns.items()
    }
    order = [*(name for name in columns if name not in _NUMBERING), *cameras, *_NUMBERING]
    return {name: {**{**numbers, **cameras}[name], **features.get(name, {})} for name in order}


def _number_table(columns: Columns) -> pa.Table:
    arrays = {
        name: pa.array(values)
        if values.ndim == 1
        else pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        for name, values in columns.items()
    }
    return pa.table(arrays)


def _write_video(path: Path, frames: NDArray[np.uint8], fps: int, lossless: bool) -> None:
    """H.264 with a key frame every other frame, as in LeRobot; one thread gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    codec, pixels, crf = ("libx264rgb", "rgb24", "0") if lossless else ("libx264", "yuv420p", "18")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            codec, rate=fps, options={"crf": crf, "g": "2", "bf": "0", "threads": "1"}
        )
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _video_feature(frames: NDArray[np.uint8]) -> dict[str, Any]:
    shape = [*frames.shape[1:]]
    return {"dtype": "video", "shape": shape, "names": ["height", "width", "channel"]}


def _write_rows(path: Path, columns: Columns, images: Mapping[str, Sequence[Path]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    table = _number_table(columns)
    schema = pa.schema([*table.schema, *(pa.field(key, _IMAGE) for key in images)])
    changes = np.zeros(table.num_rows)
    for files in images.values():
        changes += [file != before for before, file in pairwise([None, *files])]
    group = np.cumsum(changes) // _IMAGES_A_GROUP
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), table.num_rows]
    # Without arrow's schema, which would declare the type as a dictionary.
    how: dict[str, Any] = {"dictionary_pagesize_limit": _DICTIONARY_BYTES, "store_schema": False}
    with pq.ParquetWriter(path, schema, **how) as writer:
        for first, stop in pairwise(edges):
            rows = table.slice(first, stop - first)
            for key, files in images.items():
                rows = rows.append_column(key, _cells(files[first:stop]))
            writer.write_table(rows)


def _cells(files: Sequence[Path]) -> pa.StructArray:
    encoded = {file: file.read_bytes() for file in dict.fromkeys(files)}
    # Each image once: parquet drops a dictionary with duplicates and would store every row.
    place = {image: index for index, image in enumerate(dict.fromkeys(encoded.values()))}
    rows = pa.array([place[encoded[file]] for file in files], pa.int32())
    images = pa.DictionaryArray.from_arrays(rows, pa.array(list(place), pa.binary()))
    return pa.StructArray.from_arrays([images, pa.nulls(len(files), pa.string())], _IMAGE.names)
