"""Writer of a LeRobot v2.1 data set of simulated episodes, with the sensor in a sidecar.

Rows are on LeRobot's own clock, k / fps from the first. The sidecar's times are on that clock
too; the sensor begins before the first row, at a negative time.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.data.insertion import SENSOR, STATE
from pipeline.data.lerobot_writer import number_table
from pipeline.data.pickled import ACTION
from pipeline.simulation.arm import euler_actions
from pipeline.simulation.insertion import TICK_HZ, TICK_S
from pipeline.simulation.insertion_formats import INSTRUCTION
from pipeline.simulation.recorder import SimulatedEpisode
from pipeline.simulation.rendering import HEIGHT, VIEWS, WIDTH

_FPS: Final = TICK_HZ
_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_KEYS: Final = {view: f"observation.images.{view}" for view in VIEWS}
_STATISTICS_EVERY = 10
"""Frames between those that image statistics are taken from."""

_INDEX_FEATURES: Final = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def write_lerobot(root: Path, episodes: Iterable[SimulatedEpisode]) -> None:
    """Write a whole data set; episodes are taken one at a time."""
    lengths: list[int] = []
    statistics: list[dict[str, Any]] = []
    for index, episode in enumerate(episodes):
        columns, frames = _write_episode(root, index, sum(lengths), episode)
        lengths.append(len(columns["timestamp"]))
        statistics.append(_statistics(columns, frames))
    meta = root / "meta"
    meta.mkdir()
    told = {"tasks": [INSTRUCTION]}
    for name, rows in {
        "tasks": [{"task_index": 0, "task": INSTRUCTION}],
        "episodes": [{"episode_index": i, **told, "length": n} for i, n in enumerate(lengths)],
        "episodes_stats": [{"episode_index": i, "stats": s} for i, s in enumerate(statistics)],
    }.items():
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (meta / f"{name}.jsonl").write_text(lines, encoding="utf-8")
    (meta / "info.json").write_text(json.dumps(_info(lengths), indent=4), encoding="utf-8")


def _write_episode(
    root: Path, index: int, first_row: int, episode: SimulatedEpisode
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[np.uint8]]]:
    """The columns written, and some frames of each view."""
    begin = episode.epoch_s + TICK_S
    rows = round((episode.duration_s - TICK_S) / TICK_S)
    time = begin + np.arange(rows + 1, dtype=np.float64) * TICK_S
    columns = {
        "observation.state": episode.states(time[:-1]),
        "action": euler_actions(episode.poses(time)),
        "timestamp": (np.arange(rows) / _FPS).astype(np.float32),
        "frame_index": np.arange(rows),
        "episode_index": np.full(rows, index),
        "index": first_row + np.arange(rows),
        "task_index": np.zeros(rows, np.int64),
    }
    place = {"episode_chunk": 0, "episode_index": index}
    data = root / _DATA.format(**place)
    data.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(number_table(columns), data)
    some: dict[str, NDArray[np.uint8]] = {}
    for view, key in _KEYS.items():
        frames = np.stack(list(episode.frames(view, time[:-1])))
        _write_video(root / _VIDEO.format(video_key=key, **place), frames)
        some[key] = frames[::_STATISTICS_EVERY]
    sidecar = root / "sensor" / f"episode_{index:06d}.npz"
    sidecar.parent.mkdir(exist_ok=True)
    np.savez_compressed(
        sidecar,
        timestamps=episode.sensor_time - begin,
        values=episode.sensor,
        names=np.array(SENSOR.names),
        units=np.array(SENSOR.units),
    )
    return columns, some


def _write_video(path: Path, frames: NDArray[np.uint8]) -> None:
    """H.264 with a key frame every other frame, as LeRobot does; one thread, so same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264", rate=_FPS, options={"crf": "18", "g": "2", "bf": "0", "threads": "1"}
        )
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _statistics(
    columns: Mapping[str, NDArray[Any]], frames: Mapping[str, NDArray[np.uint8]]
) -> dict[str, Any]:
    """LeRobot's per-episode statistics; images in 0..1, a value a colour, shaped (3, 1, 1)."""
    stats: dict[str, Any] = {
        name: {**_of(values.reshape(len(values), -1)), "count": [len(values)]}
        for name, values in columns.items()
    }
    for key, images in frames.items():
        colours = _of(images.reshape(-1, 3) / 255)
        stats[key] = {name: np.reshape(colours[name], (3, 1, 1)).tolist() for name in colours}
        stats[key]["count"] = [len(images)]
    return stats


def _of(rows: NDArray[Any]) -> dict[str, list[Any]]:
    return {
        "min": rows.min(0).tolist(),
        "max": rows.max(0).tolist(),
        "mean": rows.mean(0, dtype=np.float64).tolist(),
        "std": rows.std(0, dtype=np.float64).tolist(),
    }


def _info(lengths: list[int]) -> dict[str, Any]:
    return {
        "codebase_version": "v2.1",
        "robot_type": "simulated_meca500",
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        "total_videos": len(lengths) * len(VIEWS),
        "total_chunks": 1,
        "chunks_size": 1000,
        "fps": _FPS,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": _DATA,
        "video_path": _VIDEO,
        "features": _features(),
    }


def _features() -> dict[str, Any]:
    """`units` beside `names` is this project's extension; other readers pass over it."""
    video = {
        "video.height": HEIGHT,
        "video.width": WIDTH,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": _FPS,
        "video.channels": 3,
        "has_audio": False,
    }
    features: dict[str, Any] = {}
    for name, channels in (("observation.state", STATE), ("action", ACTION)):
        names, units = list(channels.names), list(channels.units)
        features[name] = {"dtype": "float32", "shape": [len(names)], "names": names, "units": units}
    for key in _KEYS.values():
        names = ["height", "width", "channel"]
        shape = [HEIGHT, WIDTH, 3]
        features[key] = {"dtype": "video", "shape": shape, "names": names, "info": video}
    for name, dtype in _INDEX_FEATURES.items():
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return features
