"""A LeRobot v3.0 data set of one episode, with this project's sidecars, as its reader opens it.

Images stand in the rows as they were encoded. Equal ones are stored once, by the dictionary of the
parquet file, so that rows between two frames cost next to nothing.
"""

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.data.lerobot import MARKER

EPISODE: Final = "episode_000000"
_IMAGES_A_GROUP: Final = 64
"""Of the parquet file's rows: equal images are stored once a group, which is held in memory."""
_DICTIONARY_BYTES: Final = 2**30
_DATA: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FIRST: Final = {"chunk_index": 0, "file_index": 0}
_IMAGE: Final = pa.struct(
    [("bytes", pa.dictionary(pa.int32(), pa.binary())), ("path", pa.string())]
)


def write_data_set(
    root: Path,
    columns: Mapping[str, NDArray[Any]],
    images: Mapping[str, Sequence[Path]],
    features: Mapping[str, Mapping[str, Any]],
    task: str,
    fps: float,
) -> None:
    """Write rows and `meta/`, that last: until then the folder does not look like a recording.

    `columns` (row, …) with `timestamp` (s since the first row), and by feature key the image file
    of each row (paths repeat where images do). `features` adds to what `info.json` says of these.
    """
    rows = len(columns["timestamp"])
    whole = {name: np.zeros(rows, np.int64) for name in ("episode_index", "task_index")}
    columns = {**columns, **{name: np.arange(rows) for name in ("frame_index", "index")}, **whole}
    _write_rows(root / _DATA.format(**_FIRST), columns, images)
    told: dict[str, dict[str, Any]] = {
        name: {"dtype": str(values.dtype), "shape": [*values.shape[1:]] or [1], "names": None}
        for name, values in columns.items()
    }
    told |= {key: {"dtype": "image", "names": ["height", "width", "channel"]} for key in images}
    described = {name: {**said, **features.get(name, {})} for name, said in told.items()}
    _write_meta(root, rows, task, fps, described)


def write_sidecar(root: Path, name: str, **members: NDArray[Any]) -> None:
    """Write what LeRobot has no place for, as the episode's file in a folder of that name."""
    (root / name).mkdir()
    np.savez(root / name / f"{EPISODE}.npz", allow_pickle=False, **members)


def number_table(columns: Mapping[str, NDArray[Any]]) -> pa.Table:
    """Columns (row,) and (row, channel) of numbers, as LeRobot records them."""
    arrays = {
        name: pa.array(values)
        if values.ndim == 1
        else pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        for name, values in columns.items()
    }
    return pa.table(arrays)


def _write_rows(
    path: Path, columns: Mapping[str, NDArray[Any]], images: Mapping[str, Sequence[Path]]
) -> None:
    path.parent.mkdir(parents=True)
    table = number_table(columns)
    schema = pa.schema([*table.schema, *(pa.field(key, _IMAGE) for key in images)])
    changes = np.zeros(table.num_rows)
    for files in images.values():
        changes += [file != before for before, file in pairwise([None, *files])]
    group = np.cumsum(changes) // _IMAGES_A_GROUP
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), table.num_rows]
    # Without this project's schema, in which the type would be that of a dictionary.
    how: dict[str, Any] = {"dictionary_pagesize_limit": _DICTIONARY_BYTES, "store_schema": False}
    with pq.ParquetWriter(path, schema, **how) as writer:
        for first, stop in pairwise(edges):
            rows = table.slice(first, stop - first)
            for key, files in images.items():
                rows = rows.append_column(key, _cells(files[first:stop]))
            writer.write_table(rows)


def _cells(files: Sequence[Path]) -> pa.StructArray:
    encoded = {file: file.read_bytes() for file in dict.fromkeys(files)}
    # Each image once: parquet takes no dictionary with twins, and would store every row.
    place = {image: index for index, image in enumerate(dict.fromkeys(encoded.values()))}
    rows = pa.array([place[encoded[file]] for file in files], pa.int32())
    images = pa.DictionaryArray.from_arrays(rows, pa.array(list(place), pa.binary()))
    return pa.StructArray.from_arrays([images, pa.nulls(len(files), pa.string())], _IMAGE.names)


def _write_meta(
    root: Path, rows: int, task: str, fps: float, features: Mapping[str, Mapping[str, Any]]
) -> None:
    places = [f"{kind}/{name}" for kind in ("data", "meta/episodes") for name in _FIRST]
    counts = {"episode_index": 0, **dict.fromkeys(places, 0), "length": rows, "tasks": [task]}
    spans = {"dataset_from_index": 0, "dataset_to_index": rows}
    folder = root / "meta" / "episodes" / "chunk-000"
    folder.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist([counts | spans]), folder / "file-000.parquet")
    # LeRobot looks tasks up by the index that pandas makes of this column.
    column = {"name": "task", "field_name": "task"}
    column |= {"pandas_type": "unicode", "numpy_type": "object"}
    index = {"index_columns": ["task"], "columns": [column], "column_indexes": []}
    told = {"pandas": json.dumps(index)}
    tasks = pa.table({"task_index": [0], "task": [task]}, metadata=told)
    pq.write_table(tasks, root / "meta" / "tasks.parquet")
    totals = {"total_episodes": 1, "total_frames": rows, "total_tasks": 1, "chunks_size": 1000}
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        **totals,
        "fps": int(fps) if float(fps).is_integer() else fps,
        "splits": {"train": "0:1"},
        "data_path": _DATA,
        "video_path": None,
        "features": features,
    }
    (root / MARKER).write_text(json.dumps(info, indent=1), encoding="utf-8")
