"""Golden rows in a store: the group `golden`, beside the arrays that training maps.

`golden/<n>/<view>` is a decoded frame, compressed, in plain zarr; the root's attribute `golden` has
the row, the rendered prompt and the views of each n. Each golden row can be checked: its frames and
prompt give the key of its row. A store of an earlier version has none.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import google_crc32c
import numpy as np
import zarr
from numcodecs import Zstd
from numpy.typing import NDArray
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec

from pipeline.base.errors import StoreIncomplete
from pipeline.base.files import disk_full_named, sync
from pipeline.base.provenance import row_key
from pipeline.store.chunks import check_metadata, note_metadata
from pipeline.store.documents import FrameDocument, StoreAttributes, StoredGolden, store_border
from pipeline.store.paths import group_attributes, laid_out_attributes
from pipeline.store.schema import TRAILER_BYTES

GOLDEN: Final = "golden"
"""The group, and the attribute of the root."""
_ZSTD_LEVEL = 5


@dataclass(frozen=True, eq=False)
class GoldenFrames:
    """The rendered prompt of a VL row and its decoded frames (height, width, 3) RGB by view."""

    row: int
    prompt: str
    frames: Mapping[str, NDArray[np.uint8]]

    def key(self, spec: Mapping[str, Any]) -> bytes:
        """The key of these frames and this prompt under a feature spec."""
        return row_key(spec["digest"], spec.get("views", ()), self.prompt, self.frames)


def write_golden(root: Path, rows: Sequence[GoldenFrames]) -> None:
    """Write these golden rows into a build and replace earlier ones. Raises `DiskFull`."""
    with disk_full_named(root):
        zarr.create_group(root, path=GOLDEN, overwrite=True)
        for number, golden in enumerate(rows):
            zarr.create_group(root, path=f"{GOLDEN}/{number}")
            for view, frame in golden.frames.items():
                _write_frame(root, f"{GOLDEN}/{number}/{view}", frame)
        for path in (root / GOLDEN).rglob("*"):
            sync(path)
        entries = [{"row": g.row, "prompt": g.prompt, "views": [*g.frames]} for g in rows]
        note_metadata(root, group_attributes(root) | {GOLDEN: entries})


def read_golden(root: Path, keys: NDArray[np.uint8]) -> list[GoldenFrames]:
    """The golden rows of a store whose rows have these keys.

    Raises `StoreIncomplete`, which names the row that cannot be read or does not give its key.
    """
    attributes = laid_out_attributes(root)
    entries = enumerate(attributes.golden)
    return [_read(root, attributes, number, keys[entry.row]) for number, entry in entries]


def carried_golden(
    root: Path, spec: Mapping[str, Any], keys: NDArray[np.uint8]
) -> Iterator[GoldenFrames]:
    """The golden rows of a store that a build with this spec and these `keys` (row, 16) also has.

    Each gets the number of the build's first row with its key. Damaged ones are left out.
    """
    try:
        check_metadata(root)
        attributes = laid_out_attributes(root)
    except StoreIncomplete:
        return
    for number, entry in enumerate(attributes.golden):
        with suppress(StoreIncomplete):
            golden = _unproven(root, number, entry)
            same = keys == np.frombuffer(golden.key(spec), np.uint8)
            for row in np.flatnonzero(same.all(axis=1))[:1].tolist():
                yield replace(golden, row=row)


def golden_places(attributes: StoreAttributes) -> list[str]:
    """The folders of the group of golden rows: its own, each row's and each frame's."""
    if GOLDEN not in attributes.model_fields_set:
        return []
    places = [GOLDEN]
    for number, entry in enumerate(attributes.golden):
        places += [f"{GOLDEN}/{number}", *(f"{GOLDEN}/{number}/{view}" for view in entry.views)]
    return places


def _write_frame(root: Path, name: str, frame: NDArray[np.uint8]) -> None:
    array = zarr.create_array(
        store=root,
        name=name,
        shape=frame.shape,
        dtype=frame.dtype,
        chunks=frame.shape,
        serializer=BytesCodec(endian=None),
        filters=None,
        compressors=[ZstdCodec(level=_ZSTD_LEVEL), Crc32cCodec()],
        fill_value=0,
        dimension_names=("height", "width", "rgb"),
        config={"write_empty_chunks": True},  # a black frame has a file, too
    )
    array[:] = frame


def _read(
    root: Path, attributes: StoreAttributes, number: int, key: NDArray[np.uint8]
) -> GoldenFrames:
    """One golden row; `StoreIncomplete` where it cannot be read or does not give the key."""
    golden = _unproven(root, number, attributes.golden[number])
    if golden.key(attributes.raw["feature_spec"]) != key.tobytes():
        why = f"golden frames and prompt of VL row {golden.row} do not give the key of that row"
        raise store_border(root).refusal(root / GOLDEN / str(number), why)
    return golden


def _unproven(root: Path, number: int, entry: StoredGolden) -> GoldenFrames:
    """One golden row; `StoreIncomplete` where it cannot be read."""
    place = root / GOLDEN / str(number)
    frames = {view: _read_frame(root, place / view) for view in entry.views}
    return GoldenFrames(entry.row, entry.prompt, frames)


def _read_frame(root: Path, place: Path) -> NDArray[np.uint8]:
    """A frame (height, width, 3) of `_write_frame`; never unpacks more bytes than its shape has."""
    border = store_border(root)
    document = border.read_json(place / "zarr.json", FrameDocument)
    frame = np.zeros(document.shape, np.uint8)
    chunk = place / "c" / "0" / "0" / "0"
    packed = border.read_bytes(chunk, frame.nbytes + 2**16)
    trailer = int.from_bytes(packed[-TRAILER_BYTES:], "little")
    packed = packed[:-TRAILER_BYTES]
    try:
        if google_crc32c.value(packed) != trailer:
            raise ValueError("its bytes do not give their checksum")
        Zstd().decode(packed, out=frame)
    except (ValueError, RuntimeError) as error:
        raise border.refusal(chunk, f"golden frame cannot be read ({error})") from None
    return frame
