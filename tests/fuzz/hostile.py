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
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import zarr
from PIL import Image

from tests.fuzz.mutations import Permit, in_mode, rewrite, with_column

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


def _zeros(gigabytes: int, rows: int) -> Act:
    """An npz of one member that says it has that many rows, and unpacks to that many zeros."""

    def act(path: Path) -> None:
        with np.load(path) as archive:
            name = archive.files[-1]
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, 2)}}\n".encode()
        head = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
        rewrite(path, _zip(f"{name}.npy".encode(), head, gigabytes * 2**30))

    return act


def _zip(name: bytes, head: bytes, zeros: int) -> bytes:
    """A zip with one member, which is `head` and then that many zeros (a multiple of 2 MiB)."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    body = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(2**21)) + packer.flush(zlib.Z_FULL_FLUSH)
    body += block * (zeros // 2**21) + packer.flush()
    # Sizes stand in the 64-bit extra field, and the checksum, which is asked last, is wrong.
    extra = struct.pack("<HHQQ", 1, 16, len(head) + zeros, len(body))
    common = struct.pack("<5H", 45, 0, 8, 0, 0)
    common += struct.pack("<IIIHH", 1, 2**32 - 1, 2**32 - 1, len(name), len(extra))
    local = b"PK\x03\x04" + common + name + extra + body
    entry = b"PK\x01\x02\x2d\0" + common + bytes(14) + name + extra
    return (
        local + entry + b"PK\x05\x06" + struct.pack("<4HIIH", 0, 0, 1, 1, len(entry), len(local), 0)
    )


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


def _movie(codec: str, kind: str, width: int, height: int, pixels: str, path: Path) -> None:
    path.unlink()
    with av.open(str(path), "w", format=kind) as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        for _ in range(7 if width < 100 else 1):
            container.mux(stream.encode(av.VideoFrame(width, height, pixels)))
        container.mux(stream.encode())


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


def _png(_: int, frame: Path) -> Path:
    with Image.open(frame) as picture:
        picture.save(frame.with_suffix(".png"))
    frame.unlink()
    return frame.with_suffix(".png")


def _numbered(number: int, frame: Path) -> Path:
    return frame.rename(frame.with_name(f"{number + 1:06d}.jpg"))


def _twin(_: int, frame: Path) -> Path:
    """A frame of another camera, a tenth of a second later."""
    time = float(frame.stem.rpartition("_")[2]) + 0.1
    shutil.copy(frame, frame.with_name(f"zed_2_left_{time:.3f}.jpg"))
    return frame


def _lower(frame: Path) -> None:
    frame.parent.rename(frame.parents[1] / frame.parent.name.lower())


def _grey(path: Path) -> None:
    rewrite(path, in_mode(path.read_bytes(), "I;16"))


def _grey_cells(path: Path) -> None:
    """Likewise of the images in the rows of a table."""
    table, name = pq.ParquetFile(path).read(), "observation.images.top"
    rows = [{**row, "bytes": in_mode(row["bytes"], "I;16")} for row in table[name].to_pylist()]
    path.unlink()
    pq.write_table(with_column(table, name, rows), path)


def _in_place_of(other: str) -> Act:
    """Link the chunk of another array of a store in the place of one's."""

    def act(path: Path) -> None:
        (path.parent / "c/0").unlink()
        os.link(path.parents[2] / other / "c/0", path.parent / "c/0")

    return act


def _exchanged(other: str) -> Act:
    """Exchange the chunks of two arrays of a store."""

    def act(path: Path) -> None:
        data = (path.parent / "c/0").read_bytes()
        _in_place_of(other)(path)
        rewrite(path.parents[2] / other / "c/0", data)

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


_NUMPY = b"\x80\x04cnumpy\ndtype\n%sR."
PICKLES = {
    "2 MB of empty lists in lists": b"\x80\x04" + b"]" * 2**20 + b"a" * (2**20 - 1) + b".",
    "a text of a dtype": _NUMPY % (b"X" + struct.pack("<I", 10**6) + b"f" * 10**6 + b"\x85"),
    "a command": pickle.dumps({"action": _Runs()}),
    "a command as an extension": b"\x80\x02\x82\x01.",
    "a global by the stack": b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0ctouch canary\x85R.",
    "an object without end": b"\x80\x04(" * 10**6 + b".",
    "100,000 memo entries": b"\x80\x04]%b."
    % b"".join(b"r" + struct.pack("<I", i) for i in range(10**5)),
    "decimal digits": b"I" + b"9" * 10**6 + b"\n.",
}
_MAPPED = _set(auto_map={"AutoConfig": "evil.Evil", "AutoModel": "evil.Evil"})
_HUGE = {"shape": [2 * 10**9], "names": None}
_PLAYLIST = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{}\n#EXT-X-ENDLIST\n"
_CONCAT = "ffconcat version 1.0\nfile {}\n"
_INFO, _CONFIG, _TOKENS = "meta/info.json", "config.json", "tokenizer_config.json"
_PIXELS, _WEIGHTS, _LORA = "preprocessor_config.json", "model.safetensors", "adapter_config.json"

ACCIDENTS: list[tuple[str, str, str, Act, Permit]] = [
    *((name, "View1/*.jpg", "PNGs", _frames(_png), "same") for name in ("raw", "new")),
    ("raw", "View5/*.jpg", "one PNG", _frames(lambda n, f: f if n else _png(n, f)), "same"),
    ("old", "View1/left/*.jpg", "numbers", _frames(_numbered), "refuse"),
    *((name, "View1/*.jpg", "two cameras", _frames(_twin), "refuse") for name in ("raw", "new")),
    *((name, "View1/*.jpg", "view1/", _lower, "same") for name in ("raw", "new")),
    ("new", "View2/*.jpg", "no View2", lambda path: shutil.rmtree(path.parent), "refuse"),
    ("new", "View2/*.jpg", "no images/", lambda path: shutil.rmtree(path.parents[1]), "refuse"),
    ("lerobot_v21", _INFO, "fps of 30", _set(fps=30), "refuse"),
    ("lerobot_images", _INFO, "fps of 5", _set(fps=5), "refuse"),
    ("raw", "*.jpg", "grey of 16 bits", _grey, "any"),
    ("lerobot_images", "data/*/*.parquet", "grey of 16 bits", _grey_cells, "any"),
    ("store", "sensor/time/zarr.json", "a link", _in_place_of("state/time"), "refuse"),
    ("store", "sensor/time/zarr.json", "an exchange", _exchanged("state/time"), "refuse"),
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
    ("lerobot_v30", _INFO, "2 * 10**9 actions", _set("features", "action", **_HUGE)),
    ("lerobot_v21", _INFO, "fps of 1e308", _set(fps=1e308)),
    *(
        (f"lerobot_v{version}", _INFO, f"rows elsewhere, {absolute=}", _elsewhere(absolute))
        for version in (21, 30)
        for absolute in (False, True)
    ),
    *(
        (f"lerobot_v{version}", "*.mp4", f"a list of neighbours: {text[:9]}", _list(text))
        for version, text in ((21, _PLAYLIST), (21, _CONCAT), (30, _CONCAT))
    ),
    ("lerobot_v21", "*.mp4", "MJPEG", partial(_movie, "mjpeg", "mp4", 12000, 12000, "yuvj420p")),
    ("lerobot_v21", "*.mp4", "an AVI", partial(_movie, "mpeg4", "avi", 64, 48, "yuv420p")),
    ("new", "*.jpg", "a real JPEG of 12,500 x 12,500", partial(_image, "JPEG", 12500)),
    ("old", "*.jpg", "a PNG of 12,500 x 12,500", partial(_image, "PNG", 12500)),
    *((name, "*.npz", "6 GiB", _zeros(6, 6 * 2**27)) for name in ("raw", "new", "lerobot_images")),
    *((name, "*.npz", "10**12 rows", _zeros(0, 10**12)) for name in ("raw", "new")),
    ("vlm", _CONFIG, "code of its own", _MAPPED),
    ("vlm", _TOKENS, "code of its own", _MAPPED),
    ("vlm", _PIXELS, "10**12 pixels", _set(min_pixels=10**12, max_pixels=10**13)),
    ("vlm", _PIXELS, "patches of 0", _set(patch_size=0)),
    (
        "vlm",
        _TOKENS,
        "a template that looks inside",
        _set(chat_template="{{ ''.__class__.mro() }}"),
    ),
    ("vlm", _TOKENS, "a template that raises", _set(chat_template="{{ raise_exception('no') }}")),
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
    ("adapter", _LORA, "a runtime", _set(runtime_config={"ephemeral_gpu_offload": "yes"})),
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
