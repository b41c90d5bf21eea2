"""Writers of simulated episodes: the needle-insertion recorder's three formats, and LeRobot v3.0.

`write_raw`, `write_new` and `write_old` write one episode into its task's folder, as that
generation of the recorder left it. `write_lerobot` writes a whole data set.
"""

import json
import pickle
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from PIL import Image

from pipeline.data.insertion import CLOCK, SENSOR, STATE
from pipeline.data.lerobot import ACTION as ACTION_KEY
from pipeline.data.lerobot import STATE as STATE_KEY
from pipeline.data.lerobot_writer import LeRobotRows, write_data_set, write_sidecar
from pipeline.data.pickled import ACTION
from pipeline.simulation.arm import euler_actions
from pipeline.simulation.insertion import INSTRUCTION, STATE_HZ, TICK_HZ, TICK_S
from pipeline.simulation.needle_sensor import READING_HZ
from pipeline.simulation.recorder import Demonstration
from pipeline.simulation.rendering import JPEG_QUALITY, VIEWS

ABUTTING, OVERLAPPING = (65, 65), (650, 130)
"""Readings in a window of the new format, and readings from one window's start to the next."""

_CAMERAS: Final = {
    "View1": "zed_41182735_left",
    "View2": "zed_49429257_left",
    "View5": "oak_1944301011169A4800",
}
_MADE_UP_MACHINE = "/mnt/robot/dataset"
_GAP_ROWS = 5


def write_raw(task: Path, episode: Demonstration) -> None:
    """Write `data_collection_<stamp>/`: every stream with its clock; the robot's has a gap."""
    folder = task / f"data_collection_{episode.stamp}"
    folder.mkdir(parents=True)
    time = episode.robot_clock()
    gap = int(episode.rng.integers(len(time) // 4, len(time) // 2))
    time = np.delete(time, np.s_[gap : gap + _GAP_ROWS])
    _write_state_csv(folder / f"robot_state_{episode.stamp}.csv", episode, time)
    begun = int(episode.rng.integers(0, 50))
    stamps = episode.sensor_time[begun:]
    np.savez_compressed(
        folder / f"sensor_data_{episode.stamp}.npz",
        timestamps=stamps,
        send_timestamps=stamps + 5e-4,
        forces=episode.sensor[begun:, 0],
        alines=episode.sensor[begun:, 1:],
    )
    for view in VIEWS:
        _write_frames(folder / view, f"{_CAMERAS[view]}_", episode, view, episode.camera_clock())


def write_new(
    task: Path, episode: Demonstration, windows: tuple[int, int], robot_clock: bool
) -> None:
    """Write `episode_<stamp>/`: sensor windows (length, stride), no actions.

    Without `robot_clock` the robot's rows have no times of their own, only the metadata's.
    """
    folder = task / f"episode_{episode.stamp}"
    folder.mkdir(parents=True)
    time = episode.robot_clock() if robot_clock else episode.robot_clock(jitter_s=0.0)
    if robot_clock:
        _write_state_csv(folder / "robot_states.csv", episode, time)
    else:
        states = episode.states(time)
        joints, poses, file = states[:, :6], states[:, 6:], folder / "robot_states.npz"
        np.savez_compressed(file, robot_states=states, joints=joints, poses=poses)
    length, stride = windows
    # (window, channel, reading) -> (window, reading, channel)
    data = sliding_window_view(episode.sensor, length, axis=0)[::stride].transpose(0, 2, 1)
    ends = episode.sensor_time[length - 1 :: stride]
    np.savez_compressed(folder / "sensor_data.npz", timestamps=ends, data=data)
    frames = 0
    for view in VIEWS:
        clock = episode.camera_clock()
        _write_frames(folder / "images" / view, "", episode, view, clock)
        frames = max(frames, len(clock))
    metadata = {
        "episode_name": folder.name,
        "start_time": float(time[0]),
        "end_time": episode.epoch_s + episode.duration_s,
        "camera_views": list(VIEWS),
        "sensor_hz": READING_HZ,
        "robot_hz": STATE_HZ,
        "sensor_window_size": length,
        "action_horizon": 8,
        "action_dim": 7,
        "camera_frames_count": frames,
        "sensor_windows_count": len(ends),
        "robot_states_count": len(time),
    }
    (folder / "metadata.json").write_text(json.dumps(metadata, indent=2), encoding="utf-8")


def write_old(task: Path, episode: Demonstration) -> None:
    """Write `recv_all_<stamp>/`: actions and sensor at 10 Hz in a pickle, without a clock."""
    folder = task / f"recv_all_{episode.stamp}"
    # Rows count from the time in the earliest frame's name, so the first camera begins with them.
    start = float(np.ceil(episode.epoch_s * 1000)) / 1000
    late = start - episode.epoch_s
    images: dict[str, list[str]] = {}
    for index, view in enumerate(VIEWS):
        eye = "_left" if _CAMERAS[view].endswith("_left") else ""
        inside = Path(view, "left") if eye else Path(view)
        clock = episode.camera_clock(late + (index and episode.rng.uniform(0.01, 0.09)))
        names = _write_frames(
            folder / inside, f"{_CAMERAS[view]}_", episode, view, np.maximum(clock, start)
        )
        recorded = Path(_MADE_UP_MACHINE, task.name, folder.name, inside)
        images[view + eye] = [(recorded / name).as_posix() for name in names]
    rows = int((episode.duration_s - late) * TICK_HZ)
    time = start + np.arange(rows + 1) / TICK_HZ
    latest = np.searchsorted(episode.sensor_time, time[:-1], side="right") - 1
    sensor = episode.sensor[np.maximum(latest, 0)]
    states = episode.states(start + np.arange(rows * STATE_HZ // TICK_HZ) / STATE_HZ)
    np.savez_compressed(folder / "robot_states.npz", robot_states=states)
    document = {
        "action": euler_actions(episode.poses(time)),
        "image": images,
        "sensor_data": {"force": sensor[:, :1].copy(), "fpi": sensor[:, 1:].copy()},
        "instruction": INSTRUCTION,
        "metadata": {
            "episode_name": folder.name,
            "robot_hz": float(STATE_HZ),
            "action_hz": float(TICK_HZ),
            "num_actions": rows,
            "num_robot_states": len(states),
            "duration_seconds": episode.duration_s,
            "has_sensor": True,
        },
    }
    (folder / "data.pkl").write_bytes(pickle.dumps(document, protocol=4))


def write_lerobot(root: Path, episodes: Iterable[Demonstration]) -> None:
    """Write a LeRobot v3.0 data set, with the sensor in sidecars; episodes are taken one at a time.

    Rows are on LeRobot's own clock, k / fps from the first. The sidecars' times are on that clock
    too; the sensor begins before the first row, at a negative time.
    """
    features = {
        key: {"names": list(channels.names), "units": list(channels.units)}
        for key, channels in ((STATE_KEY, STATE), (ACTION_KEY, ACTION))
    }
    rows = _lerobot_rows(root, episodes)
    write_data_set(root, rows, features, INSTRUCTION, TICK_HZ, "simulated_meca500")


def _lerobot_rows(root: Path, episodes: Iterable[Demonstration]) -> Iterator[LeRobotRows]:
    """The rows of each episode, after its sidecar is written."""
    for index, episode in enumerate(episodes):
        begin = episode.epoch_s + TICK_S
        rows = round((episode.duration_s - TICK_S) / TICK_S)
        time = begin + np.arange(rows + 1, dtype=np.float64) * TICK_S
        columns = {
            STATE_KEY: episode.states(time[:-1]),
            ACTION_KEY: euler_actions(episode.poses(time)),
            "timestamp": (np.arange(rows) / TICK_HZ).astype(np.float32),
        }
        readings = {
            "timestamps": episode.sensor_time - begin,
            "values": episode.sensor,
            "names": np.array(SENSOR.names),
            "units": np.array(SENSOR.units),
        }
        write_sidecar(root, "sensor", readings, index, compressed=True)
        frames = {
            f"observation.images.{view}": np.stack([*episode.frames(view, time[:-1])])
            for view in VIEWS
        }
        yield LeRobotRows(columns, frames)


def _write_state_csv(path: Path, episode: Demonstration, time: NDArray[np.float64]) -> None:
    header = ("recv_timestamp", CLOCK, "send_timestamp", "force_placeholder", *STATE.names)
    clocks = [time + 0.004, time, time + 0.002, np.zeros(len(time))]
    table = np.column_stack([*clocks, episode.states(time)])
    formats = ["%.6f"] * 3 + ["%.1f"] + ["%.5f"] * len(STATE.names)
    np.savetxt(path, table, formats, delimiter=",", header=",".join(header), comments="")


def _write_frames(
    folder: Path, prefix: str, episode: Demonstration, view: str, clock: NDArray[np.float64]
) -> list[str]:
    """The names of the JPEGs written, in the clock's order."""
    folder.mkdir(parents=True)
    names = [f"{prefix}{time:.3f}.jpg" for time in clock]
    for name, frame in zip(names, episode.frames(view, clock), strict=True):
        Image.fromarray(frame).save(folder / name, quality=JPEG_QUALITY)
    return names
