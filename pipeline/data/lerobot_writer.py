"""Writes LeRobot data sets, and this project's sidecars beside them, for its own reader.

`write_v21` and `write_filmed_v30` write many episodes, with one video per view and episode;
`write_v30` writes one episode, with the encoded images unchanged in its rows. `meta/info.json` is
written last: until then the folder does not look like a recording. `units` and `kind` of a feature
are this project's extension; other readers ignore them.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

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

_DATA: Final = {
    "v2.1": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v3.0": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
_VIDEO: Final = {
    "v2.1": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    "v3.0": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
_CHUNK: Final = 1000
"""Files in a folder."""
_NUMBERING: Final = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_STATISTICS_EVERY: Final = 10
"""Image statistics use every tenth frame."""
_IMAGES_A_GROUP: Final = 64
"""Images in a row group: equal images are stored once per group, and a group is held in memory."""
_DICTIONARY_BYTES: Final = 2**30
_FIRST: Final = {"chunk_index": 0, "file_index": 0}
_IMAGE: Final = pa.struct(
    [("bytes", pa.dictionary(pa.int32(), pa.binary())), ("path", pa.string())]
)


class FilmedRows(NamedTuple):
    """The rows of one episode, and for each feature key its frames (row, height, width, 3) RGB."""

    columns: Columns
    frames: Mapping[str, NDArray[np.uint8]]


def write_v21(
    root: Path,
    episodes: Iterable[FilmedRows],
    features: Features,
    task: str,
    fps: int,
    robot_type: str,
) -> None:
    """Write a complete data set; reads one episode at a time from the iterable."""
    lengths: list[int] = []
    statistics: list[dict[str, Any]] = []
    described: dict[str, dict[str, Any]] = {}
    for index, (own, frames) in enumerate(episodes):
        columns = _numbered(own, index, sum(lengths))
        place = {"episode_chunk": 0, "episode_index": index}
        _write_filmed(root, "v2.1", place, FilmedRows(columns, frames), fps)
        lengths.append(len(columns["timestamp"]))
        statistics.append(_statistics(columns, frames))
        cameras = {key: _video_feature(film, fps) for key, film in frames.items()}
        described = _described(columns, cameras, features)
    (root / "meta").mkdir()
    for name, rows in {
        "tasks": [{"task_index": 0, "task": task}],
        "episodes": [
            {"episode_index": i, "tasks": [task], "length": n} for i, n in enumerate(lengths)
        ],
        "episodes_stats": [{"episode_index": i, "stats": s} for i, s in enumerate(statistics)],
    }.items():
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (root / "meta" / f"{name}.jsonl").write_text(lines, encoding="utf-8")
    videos = sum(feature["dtype"] == "video" for feature in described.values())
    totals = {"total_videos": len(lengths) * videos, "total_chunks": 1}
    _write_info(root, "v2.1", lengths, described, fps, robot_type, **totals)


def write_filmed_v30(
    root: Path,
    episodes: Iterable[FilmedRows],
    features: Features,
    task: str,
    fps: int,
    robot_type: str,
) -> None:
    """Write a complete data set; reads one episode at a time from the iterable.

    Each episode has its own files, which v3.0 allows; there is at least one episode.
    """
    rows: list[dict[str, Any]] = []
    described: dict[str, dict[str, Any]] = {}
    for index, (own, frames) in enumerate(episodes):
        first = rows[-1]["dataset_to_index"] if rows else 0
        columns = _numbered(own, index, first)
        length = len(columns["timestamp"])
        place = {"chunk_index": index // _CHUNK, "file_index": index % _CHUNK}
        _write_filmed(root, "v3.0", place, FilmedRows(columns, frames), fps)
        spans: dict[str, float] = {f"data/{name}": number for name, number in place.items()}
        for key in frames:
            span = {**place, "from_timestamp": 0.0, "to_timestamp": length / fps}
            spans |= {f"videos/{key}/{name}": value for name, value in span.items()}
        rows.append(_shared_row(index, first, length, task) | spans)
        cameras = {key: _video_feature(film, fps) for key, film in frames.items()}
        described = _described(columns, cameras, features)
    _write_shared_meta(root, rows, task)
    _write_info(root, "v3.0", [row["length"] for row in rows], described, fps, robot_type)


def _write_filmed(
    root: Path, version: str, place: Mapping[str, int], episode: FilmedRows, fps: int
) -> None:
    """Write the files of one episode: its numbered columns, and a video a view."""
    data = root / _DATA[version].format(**place)
    data.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(_number_table(episode.columns), data)
    for key, film in episode.frames.items():
        _write_video(root / _VIDEO[version].format(video_key=key, **place), film, fps)


def write_v30(
    root: Path,
    columns: Columns,
    images: Mapping[str, Sequence[Path]],
    features: Features,
    task: str,
    fps: float,
) -> None:
    """Write a data set of one episode; `images` has each row's image file by feature key.

    The parquet file's dictionary stores equal images once, so that rows between two frames cost
    almost nothing.
    """
    columns = _numbered(columns, 0, 0)
    _write_rows(root / _DATA["v3.0"].format(**_FIRST), columns, images)
    rows = len(columns["timestamp"])
    _write_shared_meta(root, [_shared_row(0, 0, rows, task)], task)
    cameras = {key: {"dtype": "image", "names": ["height", "width", "channel"]} for key in images}
    _write_info(root, "v3.0", [rows], _described(columns, cameras, features), fps)


def _shared_row(index: int, first: int, length: int, task: str) -> dict[str, Any]:
    """An episode's row of v3.0's `meta/episodes`, with its data in the first file."""
    places = [f"{kind}/{name}" for kind in ("data", "meta/episodes") for name in _FIRST]
    counts = {"episode_index": index, **dict.fromkeys(places, 0), "length": length, "tasks": [task]}
    return counts | {"dataset_from_index": first, "dataset_to_index": first + length}


def _write_shared_meta(root: Path, rows: list[dict[str, Any]], task: str) -> None:
    """Write `meta/episodes` and `meta/tasks.parquet` of v3.0."""
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


def _write_info(
    root: Path,
    version: Literal["v2.1", "v3.0"],
    lengths: Sequence[int],
    features: Features,
    fps: float,
    robot_type: str | None = None,
    **totals: int,
) -> None:
    info = {
        "codebase_version": version,
        "robot_type": robot_type,
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        **totals,
        "chunks_size": _CHUNK,
        "fps": int(fps) if float(fps).is_integer() else fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": _DATA[version],
        "video_path": _VIDEO[version]
        if any(f["dtype"] == "video" for f in features.values())
        else None,
        "features": features,
    }
    (root / MARKER).write_text(json.dumps(info, indent=4), encoding="utf-8")


def _number_table(columns: Columns) -> pa.Table:
    arrays = {
        name: pa.array(values)
        if values.ndim == 1
        else pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        for name, values in columns.items()
    }
    return pa.table(arrays)


def _write_video(path: Path, frames: NDArray[np.uint8], fps: int) -> None:
    """H.264 with a key frame every other frame, as in LeRobot; one thread gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264", rate=fps, options={"crf": "18", "g": "2", "bf": "0", "threads": "1"}
        )
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _video_feature(frames: NDArray[np.uint8], fps: int) -> dict[str, Any]:
    _, height, width, channels = frames.shape
    info = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": fps,
        "video.channels": channels,
        "has_audio": False,
    }
    names, shape = ["height", "width", "channel"], [height, width, channels]
    return {"dtype": "video", "shape": shape, "names": names, "info": info}


def _statistics(columns: Columns, frames: Mapping[str, NDArray[np.uint8]]) -> dict[str, Any]:
    """LeRobot's statistics of an episode; images in 0..1, one value per colour, (3, 1, 1)."""
    stats: dict[str, Any] = {
        name: {**_of(values.reshape(len(values), -1)), "count": [len(values)]}
        for name, values in columns.items()
    }
    for key, film in frames.items():
        some = film[::_STATISTICS_EVERY]
        colours = _of(some.reshape(-1, 3) / 255)
        stats[key] = {name: np.reshape(colours[name], (3, 1, 1)).tolist() for name in colours}
        stats[key]["count"] = [len(some)]
    return stats


def _of(rows: NDArray[Any]) -> dict[str, list[Any]]:
    return {
        "min": rows.min(0).tolist(),
        "max": rows.max(0).tolist(),
        "mean": rows.mean(0, dtype=np.float64).tolist(),
        "std": rows.std(0, dtype=np.float64).tolist(),
    }


def _write_rows(path: Path, columns: Columns, images: Mapping[str, Sequence[Path]]) -> None:
    path.parent.mkdir(parents=True)
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
