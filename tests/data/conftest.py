"""Small synthetic recordings in every format, written as the recorders write them."""

import json
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from pipeline.base.config import Source
from pipeline.data import Recording, open_recordings

START = 1762581333.25
STATE_NAMES = [f"joint_{i}" for i in range(1, 7)] + [f"pose_{axis}" for axis in "xyzabr"]
PATHS = {
    "v2.0": (
        "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    ),
    "v3.0": (
        "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    ),
}
VIEW_KEY = "observation.images.top"
TASKS = {"place": 7, "pick": 3}
EPISODES_V3 = "meta/episodes/chunk-000/file-000.parquet"


@dataclass
class Truth:
    """What a synthetic insertion episode holds: half a second of every stream."""

    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def __post_init__(self) -> None:
        self.state_time = START + 0.001 + np.arange(50) / 100
        self.state = self.rng.normal(size=(50, 12)).astype(np.float32)
        self.sensor_time = START + np.arange(325) / 650
        self.sensor = self.rng.normal(size=(325, 1026)).astype(np.float32)
        self.frame_time = START + np.round(np.arange(4) * 0.2, 3)
        self.action = self.rng.normal(size=(5, 7)).astype(np.float32)


def write_jpeg(path: Path, shade: int = 100) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(shaded(shade)).save(path, quality=90)
    return path


def shaded(shade: int, height: int = 48, width: int = 64) -> np.ndarray:
    """An image whose mean tells which it is."""
    image = np.full((height, width, 3), shade, np.uint8)
    image[: height // 2, : width // 2] = 255 - shade
    return image


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [",".join(header), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_raw(folder: Path, truth: Truth, views: Sequence[str] = ("View1", "View5")) -> Path:
    table = zip(truth.state_time, truth.state, strict=True)
    write_csv(
        folder / "robot_state_x.csv",
        ["recv_timestamp", "origin_timestamp", "force_placeholder", *STATE_NAMES],
        [[repr(float(t) + 9), repr(float(t)), 0.0, *map(float, row)] for t, row in table],
    )
    np.savez(
        folder / "sensor_data_x.npz",
        timestamps=truth.sensor_time,
        forces=truth.sensor[:, 0],
        alines=truth.sensor[:, 1:],
    )
    for view in views:
        for frame, time in enumerate(truth.frame_time):
            write_jpeg(folder / view / f"zed_1_left_{time:.3f}.jpg", 40 * frame)
    return folder


def write_new(
    folder: Path,
    truth: Truth,
    width: int = 65,
    stride: int = 65,
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    stops = np.arange(width, len(truth.sensor) + 1, stride)
    np.savez(
        folder / "sensor_data.npz",
        timestamps=truth.sensor_time[stops - 1],
        data=np.stack([truth.sensor[stop - width : stop] for stop in stops]),
    )
    np.savez(
        folder / "robot_states.npz",
        robot_states=truth.state,
        joints=truth.state[:, :6],
        poses=truth.state[:, 6:],
    )
    document = {
        "start_time": START,
        "sensor_hz": 650,
        "robot_hz": 100,
        "camera_views": ["View1", "View2"],
        "sensor_windows_count": len(stops),
        "robot_states_count": len(truth.state),
        **(metadata or {}),
    }
    (folder / "metadata.json").write_text(
        json.dumps({k: v for k, v in document.items() if v is not None})
    )
    for view in ("View1", "View2"):
        for frame, time in enumerate(truth.frame_time):
            write_jpeg(folder / "images" / view / f"{time:.3f}.jpg", 40 * frame)
    return folder


def write_old(
    folder: Path,
    truth: Truth,
    eyes: Sequence[str] = ("left",),
    **changes: Any,
) -> Path:
    images: dict[str, list[str]] = {"View3": []}
    for eye in eyes:
        paths = []
        for frame, time in enumerate(truth.frame_time):
            name = f"View1/{eye}/zed_1_{eye}_{time:.3f}.jpg"
            write_jpeg(folder / name, 40 * frame)
            paths.append(f"/mnt/robot/dataset/{folder.parent.name}/{folder.name}/{name}")
        images[f"View1_{eye}"] = paths
    document = {
        "action": truth.action,
        "image": images,
        "sensor_data": {"force": truth.sensor[:5, :1], "fpi": truth.sensor[:5, 1:]},
        "instruction": "insert the needle",
        "metadata": {"robot_hz": 100.0, "action_hz": 10.0},
        **changes,
    }
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "data.pkl").open("wb") as file:
        pickle.dump(document, file, protocol=4)
    return folder


def write_video(
    path: Path,
    shades: Sequence[int],
    fps: int = 10,
    codec: str = "libx264",
    group: int = 4,
    b_frames: int = 0,
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_video((*shades,), path.suffix[1:], fps, codec, group, b_frames))
    return path


@cache
def _video(
    shades: Sequence[int], suffix: str, fps: int, codec: str, group: int, b_frames: int
) -> bytes:
    options = {"g": str(group), "bf": str(b_frames)}
    if "264" in codec:
        options |= {"preset": "ultrafast", "sc_threshold": "0"}
    elif "av1" in codec:
        options |= {"preset": "12"}
    buffer = BytesIO()
    with av.open(buffer, "w", {"mkv": "matroska"}.get(suffix, suffix)) as container:
        stream = container.add_stream(codec, rate=fps, options=options)
        if codec == "mpeg4":
            stream.bit_rate = 4_000_000
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for shade in shades:
            frame = av.VideoFrame.from_ndarray(shaded(shade), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return buffer.getvalue()


def shade_of(index: int) -> int:
    """The shade of frame `index` of a LeRobot data set: tells neighbours apart."""
    return 20 + 11 * index % 200


def png(shade: int, grey_of_16_bits: bool = False) -> bytes:
    pixels, buffer = shaded(shade), BytesIO()
    if grey_of_16_bits:
        pixels = pixels[:, :, 0].astype(np.uint16) * 257
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def write_lerobot(
    root: Path,
    version: str = "v2.1",
    lengths: Sequence[int] = (7, 5, 9),
    image: bool = False,
    features: Mapping[str, Any] | None = None,
    file_of: Sequence[int] | None = None,
    tasks: Sequence[str] = ("pick", "place", "pick"),
    **columns: Any,
) -> Path:
    """A data set at 10 fps with a jittered clock; in v3.0 `file_of` has each episode's file."""
    shared = version == "v3.0"
    data_path, video_path = PATHS["v3.0" if shared else "v2.0"]
    described = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": ["a", "b"]},
        "action": {"dtype": "float32", "shape": [3], "names": [["x", "y", "gripper"]]},
        VIEW_KEY: {"dtype": "image" if image else "video", "shape": [48, 64, 3], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **(features or {}),
    }
    info = {
        "codebase_version": version,
        "fps": 10,
        "chunks_size": 1000,
        "features": {name: feature for name, feature in described.items() if feature},
        "data_path": data_path,
        "video_path": video_path,
    }
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    rng, starts, tables = np.random.default_rng(1), np.cumsum([0, *lengths]), []
    for index, length in enumerate(lengths):
        frames = starts[index] + np.arange(length)
        rows = {
            "observation.state": list(rng.normal(size=(length, 2)).astype(np.float32)),
            "action": list(rng.normal(size=(length, 3)).astype(np.float32)),
            "timestamp": (np.arange(length) / 10 + rng.uniform(0, 0.05, length)).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, index),
            "index": frames,
            "task_index": np.full(length, TASKS[tasks[index]]),
        }
        if image:
            rows[VIEW_KEY] = [{"bytes": png(shade_of(frame)), "path": None} for frame in frames]
        rows |= columns
        tables.append(pa.table({name: v for name, v in rows.items() if v is not None}))
    files = (file_of or [0] * len(lengths)) if shared else range(len(lengths))
    for file in {*files}:
        members = [index for index, of in enumerate(files) if of == file]
        place = {"chunk_index": 0, "file_index": file, "episode_chunk": 0, "episode_index": file}
        path = root / data_path.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.concat_tables([tables[index] for index in members]), path, 6)
        if not image:
            spans = [range(starts[index], starts[index + 1]) for index in members]
            shades = [shade_of(frame) for span in spans for frame in span]
            write_video(root / video_path.format(video_key=VIEW_KEY, **place), shades)
    episodes: list[dict[str, Any]] = [
        {"episode_index": index, "tasks": [tasks[index]], "length": length}
        for index, length in enumerate(lengths)
    ]
    if not shared:
        rows = [{"task_index": index, "task": text} for text, index in TASKS.items()]
        write_jsonl(root / "meta/episodes.jsonl", episodes)
        write_jsonl(root / "meta/tasks.jsonl", rows)
        return root
    for index, (row, file) in enumerate(zip(episodes, files, strict=True)):
        first = starts[min(i for i, of in enumerate(files) if of == file)]
        row |= {"data/chunk_index": 0, "data/file_index": file, "stats/action/min": [0.0]}
        row |= {"dataset_from_index": starts[index], "dataset_to_index": starts[index + 1]}
        if not image:  # spans are inexact sums, as LeRobot's own
            span = {"chunk_index": 0, "file_index": file}
            span["from_timestamp"] = float(starts[index] - first) * 0.1
            span["to_timestamp"] = float(starts[index + 1] - first) * 0.1
            row |= {f"videos/{VIEW_KEY}/{name}": value for name, value in span.items()}
    (root / EPISODES_V3).parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(episodes), root / EPISODES_V3)
    named = pa.table({"task_index": [*TASKS.values()], "__index_level_0__": [*TASKS]})
    pq.write_table(named, root / "meta/tasks.parquet")
    return root


def edit_v3(root: Path, **columns: Any) -> None:
    """Replace or add columns of `meta/episodes` of v3.0; None drops one."""
    table = pq.ParquetFile(root / EPISODES_V3).read()
    for name, cells in columns.items():
        table = table.drop_columns([name] if name in table.column_names else [])
        if cells is not None:
            table = table.append_column(name, pa.array(cells))
    pq.write_table(table, root / EPISODES_V3)


def write_jsonl(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def open_all(
    folder: Path, views: Sequence[str] | None = None, **entries: Any
) -> tuple[Recording, ...]:
    """The recordings of the source with these entries, by default that at `folder`."""
    entries = {"name": "s", "path": str(folder), **entries}
    return open_recordings([Source(**entries)], folder, views).recordings


def edit_json(path: Path, **changes: Any) -> None:
    """Lay entries over a JSON object; None removes one."""
    document = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({k: v for k, v in document.items() if v is not None}))


@pytest.fixture
def truth() -> Truth:
    return Truth()


@pytest.fixture(scope="session")
def write() -> SimpleNamespace:
    """The writers: `write.raw(folder, truth)`, `write.lerobot(root, version)` …"""
    return SimpleNamespace(
        raw=write_raw,
        new=write_new,
        old=write_old,
        lerobot=write_lerobot,
        video=write_video,
        jpeg=write_jpeg,
        csv=write_csv,
        png=png,
        jsonl=write_jsonl,
        edit_json=edit_json,
        shade_of=shade_of,
        START=START,
        STATE_NAMES=STATE_NAMES,
    )


@pytest.fixture
def only() -> Callable[..., Recording]:
    """`only(folder, instruction=…)` opens the one episode below a folder."""

    def open_one(folder: Path, views: Sequence[str] | None = None, **entries: Any) -> Recording:
        opened = open_recordings([Source(name="s", path=str(folder), **entries)], folder, views)
        assert not opened.bad, opened.bad[0].reason
        (recording,) = opened.recordings
        return recording

    return open_one
