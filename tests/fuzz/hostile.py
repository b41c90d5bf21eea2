"""What somebody would write on purpose: each a change of a file of the corpus, in one table.

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
from PIL import Image

from tests.fuzz.mutations import resized, rewrite

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


def _view(name: str) -> Act:
    """Call the view of a pickle that has frames by another name."""

    def act(path: Path) -> None:
        content = pickle.loads(path.read_bytes())
        paths = content["image"]
        paths[name] = paths.pop(max(paths, key=lambda view: len(paths[view])))
        rewrite(path, pickle.dumps(content))

    return act


def _name(name: str) -> Act:
    """Call the first channel of a sidecar so."""

    def act(path: Path) -> None:
        with np.load(path) as archive:
            members = dict(archive)
        buffer = io.BytesIO()
        np.savez(buffer, **members | {"names": np.array([name, *members["names"][1:]])})
        rewrite(path, buffer.getvalue())

    return act


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


# --- the tables ----------------------------------------------------------------------------------


class _Runs:
    """Asks to be unpickled by a command of the shell."""

    def __reduce__(self) -> Any:
        return os.system, (f"touch {CANARY}",)


_NUMPY = b"\x80\x04cnumpy\ndtype\n%sR."
_DOUBLED = b"N" + b"2\x86" * 60
_ROWS = pickle.dumps({"action": np.zeros((5, 7), np.float32)}, 2)
PICKLES = {
    "2 MB of \\x85": b"\x80\x04N" + b"\x85" * 2**21 + b".",
    "2 MB of empty lists in lists": b"\x80\x04" + b"]" * 2**20 + b"a" * (2**20 - 1) + b".",
    "\\x86 60 times as a dtype": _NUMPY % (_DOUBLED + b"\x85"),
    "\\x86 60 times as a persistent id": b"\x80\x04" + _DOUBLED + b"Q.",
    "a text of a dtype": _NUMPY % (b"X" + struct.pack("<I", 10**6) + b"f" * 10**6 + b"\x85"),
    "a frame of exabytes": b"\x80\x04\x95" + struct.pack("<Q", 2**62) + b"N.",
    "a command": pickle.dumps({"action": _Runs()}),
    "eval": f"cbuiltins\neval\n(Vopen({CANARY!r},'w')\ntR.".encode(),
    "a command as an extension": b"\x80\x02\x82\x01.",
    "a global by the stack": b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0ctouch canary\x85R.",
    "a name with dots": b"\x80\x04\x8c\x05numpy\x8c\x0ecore.os.system\x93\x8c\x04true\x85R.",
    "an array of 10**12 rows": _ROWS.replace(b"K\x05K\x07", b"\x8a\x06\0\x10\xa5\xd4\xe8\0K\x07"),
    "an object without end": b"\x80\x04(" * 10**6 + b".",
    "100,000 memo entries": b"\x80\x04]%b."
    % b"".join(b"r" + struct.pack("<I", i) for i in range(10**5)),
    "a long of 10 MB": b"\x80\x04\x8b" + struct.pack("<I", 10**7) + b"\x7f" * 10**7 + b".",
    "decimal digits": b"I" + b"9" * 10**6 + b"\n.",
}
_MAPPED = _set(auto_map={"AutoConfig": "evil.Evil", "AutoModel": "evil.Evil"})
_HUGE = {"shape": [2 * 10**9], "names": None}
_PLAYLIST = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{}\n#EXT-X-ENDLIST\n"
_CONCAT = "ffconcat version 1.0\nfile {}\n"
_INFO, _CONFIG, _TOKENS = "meta/info.json", "config.json", "tokenizer_config.json"
_PIXELS, _WEIGHTS, _LORA = "preprocessor_config.json", "model.safetensors", "adapter_config.json"

HOSTILE: list[tuple[str, str, str, Act]] = [
    *(("old", "data.pkl", name, _put(data)) for name, data in PICKLES.items()),
    ("lerobot_v21", _INFO, "a path of 3 GB", _set(data_path="{episode_index:3000000000d}")),
    ("lerobot_v30", _INFO, "a path of 3 GB", _set(video_path="{file_index:03000000000d}.mp4")),
    ("lerobot_v30", _INFO, "inside", _set(data_path="{chunk_index.__class__}/{file_index}")),
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
    *(
        (
            "raw",
            "*.jpg",
            f"{n} pixels a side",
            lambda p, n=n: rewrite(p, resized(p.read_bytes(), n, n)),
        )
        for n in (12500, 65500)
    ),
    ("new", "*.jpg", "a real JPEG of 12,500 x 12,500", partial(_image, "JPEG", 12500)),
    ("old", "*.jpg", "a PNG of 12,500 x 12,500", partial(_image, "PNG", 12500)),
    ("raw", "*.jpg", "a GIF of 12,000 x 12,000", partial(_image, "GIF", 12000)),
    ("raw", "*.jpg", "PostScript", _put(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")),
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
    ("store", "tick/time/zarr.json", "10**12 ticks", _rows(10**12)),
    ("store", "tick/action/zarr.json", "-1 rows", _rows(-1)),
    (
        "store",
        "state/values/zarr.json",
        "chunks of 1",
        _set("chunk_grid", "configuration", chunk_shape=[1, 1]),
    ),
    (
        "store",
        "state/time/zarr.json",
        "a codec from elsewhere",
        _set(codecs=[{"name": "numcodecs.pickle", "configuration": {}}]),
    ),
    ("store", "vl/time/zarr.json", "a transformer", _set(storage_transformers=[{"name": "evil"}])),
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
    *(
        ("old", "data.pkl", f"the view {name!r:.40}", _view(name))
        for name in ("../../../../up", "/tmp/up", ".hidden", "a\\b", "zarr.json", "\u00e9" * 200)
    ),
    ("lerobot_images", "*.npz", "a name with NUL", _name("a\0b")),
    ("lerobot_images", "*.npz", "a name of 20,000 characters", _name("a" * 20_000)),
]
"""The thing of the corpus, which file of it (by `rglob`), what is done to it in words, and how."""
