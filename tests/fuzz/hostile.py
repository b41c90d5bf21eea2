"""What chance never does to one file: accidents of several files, and what somebody would write on
purpose. Each is a change of a thing of the corpus, in one table.

Nothing of it may run code, open what lies elsewhere, take gigabytes or go on for ever; pickles,
checkpoints and adapters made to be slow are left out, as nobody defends against them. What runs
makes the file CANARY in the folder of the case, where commands are run.
"""

import io
import json
import os
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from PIL import Image

from tests.fuzz.mutations import Permit, rewrite

CANARY = "canary"
Act = Callable[[Path], object]

# --- ways of changing the file at a path ---------------------------------------------------------


def _put(data: bytes) -> Act:
    return lambda path: rewrite(path, data)


def _edit(change: Callable[[Any], object]) -> Act:
    """Change a JSON document in place."""

    def act(path: Path) -> None:
        document = json.loads(path.read_bytes())
        change(document)
        rewrite(path, json.dumps(document).encode())

    return act


def _set(*place: str | int, **values: Any) -> Act:
    """Give keys of the object at a place of a JSON document other values."""

    def change(node: Any) -> None:
        for key in place:
            node = node[key]
        node.update(values)

    return _edit(change)


def _rows(count: int) -> Act:
    return _edit(lambda document: document["shape"].__setitem__(0, count))


def _sparse(path: Path) -> None:
    """A terabyte that takes no room."""
    rewrite(path, path.read_bytes())
    os.truncate(path, 2**40)


def _lying(path: Path) -> None:
    """An npz of one member that says it has 10**12 rows."""
    with np.load(path) as archive:
        name = archive.files[-1]
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 2)}\n"
    path.unlink()
    with zipfile.ZipFile(path, "w") as archive:
        head = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
        archive.writestr(f"{name}.npy", head)


def _elsewhere(absolute: bool) -> Act:
    """Rows that are where the template leads, which is beside the data set."""

    def act(path: Path) -> None:
        outside = path.parents[2] / "elsewhere"
        shutil.move(path.parents[1] / "data", outside / "data")
        up = str(outside) if absolute else "../elsewhere"
        _edit(lambda info: info.update(data_path=f"{up}/{info['data_path']}"))(path)

    return act


def _weights(there: str) -> Act:
    """Weights that are where an index leads, which is beside the checkpoint."""

    def act(path: Path) -> None:
        data = path.read_bytes()
        names = json.loads(data[8 : 8 + struct.unpack("<Q", data[:8])[0]])
        shutil.move(path, path.parents[1] / "elsewhere.safetensors")
        index = dict.fromkeys(names.keys() - {"__metadata__"}, there.format(path.parents[1]))
        text = json.dumps({"metadata": {}, "weight_map": index})
        path.with_name("model.safetensors.index.json").write_text(text)

    return act


def _list(text: str) -> Act:
    """A text in the place of a video that names the video beside it."""

    def act(path: Path) -> None:
        real = path.rename(path.with_name("real.mp4"))
        path.write_text(text.format(real.name))

    return act


def _image(kind: str, size: int, path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("L", (size, size)).save(buffer, kind)
    rewrite(path, buffer.getvalue())


def _manifest(store: dict[str, Any]) -> None:
    metadata = store["attributes"]["archive"]["metadata"]
    metadata["../../escaped/zarr.json"] = metadata["zarr.json"]


def _frames(change: Callable[[int, Path], Path]) -> Act:
    """Change every frame of a view and its name, in the pickle of the old format too."""

    def act(path: Path) -> None:
        frames = sorted(path.parent.iterdir())
        names = {frame.name: change(n, frame).name for n, frame in enumerate(frames)}
        for file in path.parents[2].glob("data.pkl"):
            content = pickle.loads(file.read_bytes())
            for paths in content["image"].values():
                split = (path.rpartition("/") for path in paths)
                paths[:] = [f"{folder}/{names[name]}" for folder, _, name in split]
            rewrite(file, pickle.dumps(content))

    return act


def _numbered(number: int, frame: Path) -> Path:
    return frame.rename(frame.with_name(f"{number + 1:06d}.jpg"))


def _twin(_: int, frame: Path) -> Path:
    """A frame of another camera, a tenth of a second later."""
    time = float(frame.stem.rpartition("_")[2]) + 0.1
    shutil.copy(frame, frame.with_name(f"zed_2_left_{time:.3f}.jpg"))
    return frame


def _in_place_of(other: str) -> Act:
    """Link the chunk of another array of a store in the place of one's."""

    def act(path: Path) -> None:
        (path.parent / "c/0").unlink()
        os.link(path.parents[2] / other / "c/0", path.parent / "c/0")

    return act


def _backwards(*arrays: str) -> Act:
    """Have the rows of a store's arrays in reverse, in chunks that give their checksums."""

    def act(path: Path) -> None:
        for name in arrays:
            folder = path.parents[2] / name
            for chunk in (path for path in (folder / "c").rglob("*") if path.is_file()):
                rewrite(chunk, chunk.read_bytes())
            array: Any = zarr.open_array(folder, mode="r+")
            array[:] = array[:][::-1]

    return act


# --- the tables ----------------------------------------------------------------------------------


class _Runs:
    """Asks to be unpickled by a command of the shell."""

    def __reduce__(self) -> Any:
        return os.system, (f"touch {CANARY}",)


PICKLES = {
    "a command": pickle.dumps({"action": _Runs()}),
    "a command as an extension": b"\x80\x02\x82\x01.",
    "a global by the stack": b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0ctouch canary\x85R.",
    "decimal digits": b"I" + b"9" * 10**6 + b"\n.",
}
_MAPPED = _set(auto_map={"AutoConfig": "evil.Evil", "AutoModel": "evil.Evil"})
_HUGE = {"shape": [2 * 10**9], "names": None}
_PLAYLIST = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{}\n#EXT-X-ENDLIST\n"
_CONCAT = "ffconcat version 1.0\nfile {}\n"
_INFO, _CONFIG, _TOKENS = "meta/info.json", "config.json", "tokenizer_config.json"
_PIXELS, _WEIGHTS, _LORA = "preprocessor_config.json", "model.safetensors", "adapter_config.json"

ACCIDENTS: list[tuple[str, str, str, Act, Permit]] = [
    ("old", "View1/left/*.jpg", "numbers", _frames(_numbered), "refuse"),
    *((name, "View1/*.jpg", "two cameras", _frames(_twin), "refuse") for name in ("raw", "new")),
    ("new", "View2/*.jpg", "no View2", lambda path: shutil.rmtree(path.parent), "refuse"),
    ("new", "View2/*.jpg", "no images/", lambda path: shutil.rmtree(path.parents[1]), "refuse"),
    ("lerobot_v21", _INFO, "fps of 30", _set(fps=30), "refuse"),
    ("lerobot_images", _INFO, "fps of 5", _set(fps=5), "refuse"),
    ("store", "sensor/time/zarr.json", "a link", _in_place_of("state/time"), "refuse"),
    ("store", "tick/action/zarr.json", "an older chunk", _backwards("tick/action"), "refuse"),
    (
        "store",
        "vl/features/zarr.json",
        "rows with checksums of their own",
        _backwards("vl/features", "vl/checksum"),
        "refuse",
    ),
]
"""As below, and what each permits: the file is still one of its kind."""
HOSTILE: list[tuple[str, str, str, Act] | tuple[str, str, str, Act, Permit]] = [
    *ACCIDENTS,
    *(("old", "data.pkl", name, _put(data)) for name, data in PICKLES.items()),
    ("lerobot_v21", _INFO, "2 * 10**9 states", _set("features", "observation.state", **_HUGE)),
    *(
        (f"lerobot_v{version}", _INFO, f"rows elsewhere, {absolute=}", _elsewhere(absolute))
        for version in (21, 30)
        for absolute in (False, True)
    ),
    *(
        (f"lerobot_v{version}", "*.mp4", f"a list of neighbours: {text[:9]}", _list(text))
        for version, text in ((21, _PLAYLIST), (21, _CONCAT), (30, _CONCAT))
    ),
    ("new", "*.jpg", "a real JPEG of 12,500 x 12,500", partial(_image, "JPEG", 12500)),
    ("old", "*.jpg", "a PNG of 12,500 x 12,500", partial(_image, "PNG", 12500)),
    *((name, "*.npz", "10**12 rows", _lying) for name in ("raw", "new", "lerobot_images")),
    ("vlm", _CONFIG, "code of its own", _MAPPED),
    ("vlm", _TOKENS, "code of its own", _MAPPED),
    ("vlm", _PIXELS, "10**12 pixels", _set(min_pixels=10**12, max_pixels=10**13)),
    (
        "vlm",
        _TOKENS,
        "a template that looks inside",
        _set(chat_template="{{ ''.__class__.mro() }}"),
    ),
    ("vlm", _WEIGHTS, "weights outside, by ..", _weights("../elsewhere.safetensors")),
    ("vlm", _WEIGHTS, "weights outside, by an absolute path", _weights("{}/elsewhere.safetensors")),
    ("vlm", _WEIGHTS, "weights in a pickle", _weights("pytorch_model.bin")),
    ("adapter", _LORA, "code of its own", _MAPPED),
    (
        "adapter",
        _LORA,
        "a module to import",
        _set(megatron_config={"a": 1}, megatron_core="antigravity"),
    ),
    ("adapter", _LORA, "adapters of the hub", _set(peft_type="XLORA", adapters={"a": "b/c"})),
    ("store", "vl/features/zarr.json", "10**12 rows", _rows(10**12)),
    ("store", "sensor/values/zarr.json", "10**12 readings", _rows(10**12)),
    ("archive", "archive.zarr/zarr.json", "the manifest names a path outside", _edit(_manifest)),
    ("archive", "vl/features/zarr.json", "10**12 rows", _rows(10**12)),
    *(
        (subject, name, "a terabyte", _sparse)
        for subject, names in {
            "raw": "*.npz *.csv *.jpg",
            "new": "metadata.json",
            "lerobot_v30": "*.parquet",
            "vlm": "*.safetensors",
            "store": "c/*",
            "archive": "c/*",
            "head": "*.safetensors policy.json",
        }.items()
        for name in names.split()
    ),
]
"""The thing of the corpus, which file of it (by `rglob`), what is done to it in words, and how."""
