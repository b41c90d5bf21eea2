"""What files hold, read as plainly as can be: numpy, json, csv, pyarrow, PIL and PyAV, nothing of
the project. It takes what stands there word by word and raises over everything else.

A recording is, by episode, a dictionary of arrays and texts; `NaN` in a clock means that the format
leaves that time to the reader.
"""

import _codecs
import csv
import io
import json
import os
import pickle
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy._core import multiarray, numeric
from PIL import Image

Episode = dict[str, Any]
"""`instruction`, `state.time`, `state.values`, `sensor.…`, `action.…` and for each view
`frames.<view>` and `frames.<view>.time`."""

STATE = [f"joint_{i}" for i in range(1, 7)] + [f"pose_{axis}" for axis in "xyzabr"]
NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
INFERRED = {f"{s}.{w}" for s in ("state", "sensor", "action") for w in ("names", "units")}
"""What a reader may add to a recording that says nothing of it."""


class Strange(Exception):
    """A plain reader would not take it."""


def need(holds: object, what: object) -> None:
    """Raise `Strange` where it does not."""
    if not holds:
        raise Strange(str(what))


def recording(kind: str, root: Path) -> dict[str, Episode]:
    """What the recordings of a kind below a folder hold, by the episode's folder."""
    if kind.startswith("lerobot"):
        return dict(lerobot(root))
    reader = {"raw": raw, "new": new, "old": old}[kind.removeprefix("real_")]
    return {
        path.name: {"instruction": path.parent.name.replace("_", " ")} | reader(path)
        for path in root.glob("*/*")
        if path.is_dir()
    }


# --- parts of formats ----------------------------------------------------------------------------


def json_object(text: bytes) -> dict[str, Any]:
    """A JSON object of UTF-8 without NaN."""
    document = json.loads(text.decode("utf-8"), parse_constant=lambda name: need(False, name))
    need(type(document) is dict, "an object")
    return document


def number(value: object, whole: bool = False) -> Any:
    """A finite number that is none of another type."""
    need(type(value) in ((int,) if whole else (int, float)), f"a number: {value!r:.99}")
    need(np.isfinite(float(value)), value)  # type: ignore[arg-type]
    return value


def numbers(array: Any, width: int | None = None) -> np.ndarray:
    """An array of finite numbers, with so many columns."""
    need(isinstance(array, np.ndarray) and array.dtype.kind in "fiu", f"numbers: {array!r:.99}")
    need(width is None or (array.ndim == 2 and array.shape[1] == width), array.shape)
    with np.errstate(over="ignore"):
        need(np.isfinite(array).all() and np.isfinite(array.astype("f4")).all(), "finite")
    return array


def resolved(array: np.ndarray) -> np.ndarray:
    """Times whose type tells readings apart: steps of it are shorter than two readings."""
    if array.dtype.kind == "f" and len(array) > 1:
        apart = float(np.ptp(array)) / (len(array) - 1)
        need(float(np.spacing(np.abs(array).max())) <= max(2 * apart, 1e-6), array.dtype)
    return array


def texts(value: Any, count: int) -> list[str]:
    """A list of so many texts."""
    need(type(value) is list and all(type(text) is str for text in value), value)
    need(len(value) == count, value)
    return value


def npz(path: Path, wanted: str) -> dict[str, np.ndarray]:
    """Those members that are there."""
    with np.load(path) as archive:
        return {name: numbers(archive[name]) for name in wanted.split() if name in archive.files}


def image(file: Path | BinaryIO) -> np.ndarray:
    """The pixels of a JPEG or PNG, the upper eight bits of grey ones of sixteen."""
    with Image.open(file, formats=("JPEG", "PNG")) as picture:
        if picture.mode == "I;16":
            picture = Image.fromarray((np.asarray(picture) >> 8).astype(np.uint8))
        need(picture.mode in ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK"), picture.mode)
        return np.asarray(picture.convert("RGB"))


def views(folders: Iterable[Path]) -> Episode:
    """The frames of folders that have any; their times are in their names."""
    episode: Episode = {}
    for folder in folders:
        timed = []
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.suffix.lower() in (".jpg", ".jpeg", ".png") and path.name[0] != ".":
                timed.append(_timed(path))
        episode |= _view(re.sub(r"^view(?=\d)", "View", folder.name), sorted(timed))
    return episode


def _timed(path: Path) -> tuple[float, str]:
    """A frame's time, which is not its number, and its path."""
    word = path.stem.rsplit("_", 1)[-1]
    need(NUMBER.fullmatch(word) and not re.fullmatch(r"0\d+", word) and path.is_file(), path.name)
    return float(word), str(path)


def _view(name: str, timed: list[tuple[float, str]]) -> Episode:
    """The frames of one camera, whose names begin all alike or each in its own way."""
    paths = {Path(path) for _, path in timed}
    cameras = {path.stem.rpartition("_")[0] for path in paths}
    need(len(cameras) in (0, 1, len(paths)), f"one camera: {cameras}")
    frames = {f"frames.{name}": [image(Path(path)) for _, path in timed]}
    return frames | {f"frames.{name}.time": np.array([t for t, _ in timed])} if timed else {}


# --- the recorder's formats ----------------------------------------------------------------------


def raw(folder: Path) -> Episode:
    """The raw format."""
    (path,) = folder.glob("robot_state_*.csv")
    with path.open(newline="", encoding="utf-8-sig") as file:
        header, *rows = (row for row in csv.reader(file) if row)
    names = [name.strip() for name in header]
    wanted = ["origin_timestamp", *STATE]
    need(all(names.count(name) == 1 for name in wanted), "each column once")
    need(all(len(row) >= len(names) and not any(row[len(names) :]) for row in rows), "width")
    cells = [[row[names.index(name)] for name in wanted] for row in rows]
    need(all(NUMBER.fullmatch(cell) for row in cells for cell in row), "numbers")
    columns = numbers(np.array(cells, np.float64))
    found: Episode = {"state.time": columns[:, 0], "state.values": columns[:, 1:]}
    for path in folder.glob("sensor_data_*.npz"):
        read = npz(path, "timestamps forces alines")
        forces = read["forces"].reshape(len(read["alines"]), 1)
        found["sensor.time"] = resolved(read["timestamps"])
        found["sensor.values"] = np.concatenate([forces, read["alines"]], axis=1)
    return found | views(folder.glob("[Vv]iew*"))


def _states(folder: Path, start: object, rate: object) -> Episode:
    """`robot_states.npz`, which has no clock."""
    path = folder / "robot_states.npz"
    if not path.is_file():
        return {}
    read = npz(path, "robot_states joints poses")
    if "robot_states" not in read:
        read["robot_states"] = np.concatenate([read["joints"], read["poses"]], axis=1)
    need(len({len(array) for array in read.values()}) == 1, "equal lengths")
    rows = numbers(read["robot_states"], len(STATE))
    return {"state.values": rows, "state.time": number(start) + np.arange(len(rows)) / number(rate)}


def new(folder: Path) -> Episode:
    """The new format; windows of the corpus abut."""
    said = json_object((folder / "metadata.json").read_bytes())
    found = _states(folder, said.get("start_time"), said.get("robot_hz"))
    told = {"robot_states_count": len(found.get("state.values", ()))}
    if (folder / "sensor_data.npz").is_file():
        read = npz(folder / "sensor_data.npz", "timestamps data")
        count, width, channels = read["data"].shape
        need(channels == 1026 and read["timestamps"].shape == (count,), read["data"].shape)
        told["sensor_windows_count"] = count
        time = np.full((count, width), np.nan)
        time[:, -1] = resolved(read["timestamps"])
        found["sensor.values"] = read["data"].reshape(count * width, channels)
        found["sensor.time"] = time.reshape(-1)
    for key, count in told.items():
        need(said.get(key) is None or number(said[key]) == count or not count, key)
    found |= views((folder / "images").glob("*"))
    for view in said.get("camera_views") or ():
        need(f"frames.{view}" in found, f"frames of {view}")
    return found


class _Plain(pickle.Unpickler):
    """Knows arrays and nothing else."""

    KNOWN = (np.ndarray, np.dtype, multiarray._reconstruct, numeric._frombuffer, multiarray.scalar)

    def find_class(self, module: str, name: str) -> Any:
        known = {known.__name__: known for known in (*self.KNOWN, _codecs.encode)}
        need(name in known, f"{module}.{name}")
        return known[name]


def _given(document: dict[str, Any], key: str, default: Any) -> Any:
    value = default if document.get(key) is None else document[key]
    need(type(value) is type(default) or type(default) is float, key)
    return value


def old(folder: Path) -> Episode:
    """The old format."""
    with (folder / "data.pkl").open("rb") as file:
        said = _Plain(file).load()
    need(type(said) is dict, "a dict")
    metadata = _given(said, "metadata", {})
    tick, rate = (
        number(_given(metadata, f"{of}_hz", hz)) for of, hz in (("action", 10.0), ("robot", 100.0))
    )
    found: Episode = {}
    for view, paths in _given(said, "image", {}).items():
        need(type(paths) in (list, tuple) and type(view) is str, "paths")
        there = [_tail(folder, path) for path in paths]
        found |= _view(view.removesuffix("_left"), sorted(map(_timed, there)))
    start = min((time[0] for key, time in found.items() if key.endswith(".time")), default=0.0)
    start = float(start)
    found |= {"action.values": numbers(said["action"], 7), "action.rate_hz": [tick]}
    if (sensor := said.get("sensor_data")) is not None:
        if type(sensor) is dict:
            force = np.asarray(sensor["force"]).reshape(-1, 1)
            sensor = np.concatenate([force, numbers(sensor["fpi"], 1025)], axis=1)
        found["sensor.values"] = numbers(sensor, 1026)
    for stream in ("action", "sensor"):
        if (rows := found.get(f"{stream}.values")) is not None:
            found[f"{stream}.time"] = start + np.arange(len(rows)) / tick
    if told := _given(said, "instruction", ""):
        found["instruction"] = told
    return found | _states(folder, start, rate)


def _tail(folder: Path, recorded: str) -> Path:
    need(
        type(recorded) is str and "\0" not in recorded and ".." not in Path(recorded).parts,
        recorded,
    )
    parts = Path(recorded).parts
    tails = (folder.joinpath(*parts[depth:]) for depth in range(1, len(parts)))
    return next(path for path in tails if path.is_file())


# --- LeRobot -------------------------------------------------------------------------------------

PLACE = re.compile(r"(?:[^{}]|\{(?:\w+)(?::0?\d{1,3}d)?\})*")


def _place(root: Path, template: Any, **fields: Any) -> Path:
    """The file that a template of a LeRobot data set names, within it."""
    need(type(template) is str and PLACE.fullmatch(template), f"a template: {template!r:.99}")
    path = root / template.format(**fields)
    need(Path(os.path.normpath(path)).is_relative_to(root), path)
    if not path.is_file():
        raise FileNotFoundError(path)
    return path


def lerobot(root: Path) -> Iterator[tuple[str, Episode]]:
    """The episodes of a LeRobot data set."""
    info = json_object((root / "meta/info.json").read_bytes())
    need(info["codebase_version"] in ("v2.0", "v2.1", "v3.0"), info["codebase_version"])
    need(number(info["fps"]) > 0 and type(info["features"]) is dict, "fps and features")
    tasks: dict[Any, str] = {}
    for row in _rows(root / "meta", "tasks"):
        text = row.get("task", row.get("__index_level_0__"))
        need(type(text) is str, text)
        tasks[number(row["task_index"], whole=True)] = text
    rows = list(_rows(root / "meta", "episodes"))
    indices = [number(row["episode_index"], whole=True) for row in rows]
    need(len({*indices}) == len(rows), "each episode once")
    for index, row in zip(indices, rows, strict=True):
        try:
            yield f"episode_{index:06d}", _lerobot_episode(root, info, row, index, tasks)
        except FileNotFoundError:  # an episode whose files are not there is passed over, and told
            continue


def _rows(meta: Path, name: str) -> Iterable[dict[str, Any]]:
    if (path := meta / f"{name}.jsonl").is_file():
        return [json_object(line) for line in path.read_bytes().splitlines() if line.strip()]
    paths = [meta / f"{name}.parquet", *sorted((meta / name).rglob("*.parquet"))]
    return [row for path in paths if path.is_file() for row in pq.read_table(path).to_pylist()]


def _lerobot_episode(root: Path, info: Any, row: Any, index: int, tasks: dict[Any, str]) -> Episode:
    three, length = info["codebase_version"] == "v3.0", number(row["length"], whole=True)
    if three:
        where = {f: number(row[f"data/{f}"], whole=True) for f in ("chunk_index", "file_index")}
        every = [path for path in sorted((root / "data").rglob("*.parquet")) if path.is_file()]
    else:
        chunk = index // number(info["chunks_size"], whole=True)
        where, every = {"episode_index": index, "episode_chunk": chunk}, []
    mine: list[int] = []
    for path in [_place(root, info["data_path"], **where), *every]:
        table = pq.ParquetFile(path).read()
        indices = table["episode_index"].to_pylist()
        if mine := [place for place, one in enumerate(indices) if one == index]:
            break
    need(mine == list(range(mine[0], mine[0] + length)), f"{length} rows together")
    need(three or len(indices) == length, "its own rows")
    table = table.take(mine)
    columns = {name: table[name] for name in table.column_names}
    clock = _vectors(columns["timestamp"], 1)[:, 0]
    steps = np.diff(clock)
    if "action" in info["features"] and (steps > 0).any():
        rates = 1 / np.array([np.median(steps[steps > 0]), steps.mean()])
        need(abs(rates / info["fps"] - 1).min() <= 0.1, f"{rates} Hz, as fps says")
    told = row.get("tasks") or []
    asked = {*columns["task_index"].to_pylist()} if "task_index" in columns else {None}
    if len(texts(told, len(told))) != 1:
        need(len(asked) == 1, "one task")
        told = [tasks[asked.pop()]]
    found: Episode = {"instruction": told[0]}
    if "action" in info["features"]:
        found["action.rate_hz"] = [info["fps"]]
    for stream, column in (("state", "observation.state"), ("action", "action")):
        if column in info["features"]:
            words = _words(info["features"][column])
            values = _vectors(columns[column], len(words["units"]))
            found |= {f"{stream}.{word}": value for word, value in words.items()}
            found |= {f"{stream}.values": values, f"{stream}.time": clock}
    for stream in ("sensor", "state"):
        if (path := root / stream / f"episode_{index:06d}.npz").is_file():
            found = {k: v for k, v in found.items() if not k.startswith(f"{stream}.")}
            read = npz(path, "timestamps values")
            found |= {
                f"{stream}.time": resolved(read["timestamps"]),
                f"{stream}.values": read["values"],
            }
            with np.load(path) as archive:
                for word in {"names", "units"} & {*archive.files}:
                    need(archive[word].dtype.kind == "U", "words")
                    found[f"{stream}.{word}"] = list(archive[word])
    for key, feature in info["features"].items():
        view = key.removeprefix("observation.images.").removeprefix("observation.")
        if feature.get("dtype") == "image":
            need(isinstance(columns[key].type, pa.StructType), columns[key].type)
            frames = [image(io.BytesIO(cell["bytes"])) for cell in columns[key].to_pylist()]
        elif feature.get("dtype") == "video":
            frames = _video(root, info, row, key, where, length)
        else:
            continue
        found |= {f"frames.{view}": frames, f"frames.{view}.time": clock}
    return found


def _words(feature: dict[str, Any]) -> dict[str, list[str]]:
    (width,) = feature["shape"]
    need(0 < number(width, whole=True) < 10_000, width)
    names, units = feature.get("names"), feature.get("units")
    if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    named = {} if names is None else {"names": texts(names, width)}
    return named | {"units": texts([""] * width if units is None else units, width)}


def _vectors(column: Any, width: int) -> np.ndarray:
    rows = column.to_pylist()
    need(all(type(x) in (int, float) for x in np.ravel(np.array(rows, object))), "numbers")
    return numbers(np.array(rows, np.float64).reshape(len(rows), -1), width)


def _video(root: Path, info: Any, row: Any, key: str, where: Any, length: int) -> list[np.ndarray]:
    first = 0
    shared = info["codebase_version"] == "v3.0"
    if shared:
        said = {name: row[f"videos/{key}/{name}"] for name in where}
        where = {name: number(value, whole=True) for name, value in said.items()}
        begin, end = (number(row[f"videos/{key}/{n}_timestamp"]) for n in ("from", "to"))
        first = round(begin * info["fps"])
        need(abs(begin * info["fps"] - first) <= 0.1, "the time of a frame")
        need(round((end - begin) * info["fps"]) == length, "as many frames as rows")
    path = _place(root, info["video_path"], video_key=key, **where)
    known = {"format_whitelist": "mov,mp4,matroska,webm,avi"}
    with av.open(str(path), container_options=known) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    need(first >= 0 and len(frames) >= first + length, len(frames))
    need(shared or len(frames) == length, len(frames))
    return frames[first : first + length]


# --- what was read, and what is there ------------------------------------------------------------


def difference(read: Mapping[str, Episode], plain: Mapping[str, Episode]) -> str:
    """The first place at which what was read is not what a plain reader finds; empty if none."""
    if read.keys() != plain.keys():
        return f"read the episodes {sorted(read)}, there are {sorted(plain)}"
    for name, episode in read.items():
        other = plain[name]
        if strange := (other.keys() ^ episode.keys()) - (INFERRED - other.keys()):
            return f"{name}: {min(strange)} was read, or is there, but not both"
        for key in other:
            if why := _differ(episode[key], other[key], key):
                return f"{name}, {key}: {why}"
    return ""


def _differ(mine: Any, theirs: Any, key: str) -> str:
    if key.endswith((".names", ".units", "instruction")):
        same = list(mine) == list(theirs)
        return "" if same else f"read {mine!r:.80}, there is {theirs!r:.80}"
    if len(mine) != len(theirs):
        return f"read {len(mine)} rows, there are {len(theirs)}"
    if key.startswith("frames.") and not key.endswith(".time"):
        wrong = [
            i for i, pair in enumerate(zip(mine, theirs, strict=True)) if not np.array_equal(*pair)
        ]
        return f"frames {wrong} are others" if wrong else ""
    # Clocks of float32 are made exact, values are kept in float32.
    given, there = np.asarray(theirs, np.float64), np.asarray(mine, np.float64)
    if there.shape != given.shape:
        return f"read {there.shape}, there is {given.shape}"
    clock = key.endswith(".time")
    close = np.isclose(there, given, rtol=0.0 if clock else 3e-7, atol=2e-6, equal_nan=True)
    wrong = ~close & ~(np.isnan(given) & clock)
    return f"{wrong.sum()} of {wrong.size} numbers are others" if wrong.any() else ""
