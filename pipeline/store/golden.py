"""Golden rows in a store: the group `golden`, beside the arrays that training maps.

`golden/<n>/<view>` are decoded frames, compressed, as plain zarr reads them; the root's attribute
`golden` says of each n its row, rendered prompt and views. They prove themselves: frames and prompt
give the key of their row. A store of an earlier version has none.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec

from pipeline.base.durable import disk_full_named, sync
from pipeline.base.errors import StoreIncomplete
from pipeline.base.golden import row_key
from pipeline.base.issue import Issue
from pipeline.store.chunks import read_rows
from pipeline.store.metadata import check_metadata, note_metadata
from pipeline.store.repair_hints import mend
from pipeline.store.schema import ArraySpec

GOLDEN: Final = "golden"
"""The group, and the attribute of the root."""
_ZSTD_LEVEL = 5


@dataclass(frozen=True, eq=False)
class GoldenFrames:
    """The decoded frames and the rendered prompt of a VL row."""

    row: int
    prompt: str
    frames: Mapping[str, NDArray[np.uint8]]
    """By view: (height, width, 3) RGB."""

    def key(self, spec: Mapping[str, Any]) -> bytes:
        """The row's key, where they are what its features were computed from."""
        return row_key(spec["digest"], spec.get("views", ()), self.prompt, self.frames)


def write_golden(root: Path, rows: Sequence[GoldenFrames]) -> None:
    """Put these golden rows into a build, in place of what was there. Raises `DiskFull`."""
    with disk_full_named(root):
        zarr.create_group(root, path=GOLDEN, overwrite=True)
        for number, golden in enumerate(rows):
            zarr.create_group(root, path=f"{GOLDEN}/{number}")
            for view, frame in golden.frames.items():
                _write_frame(root, f"{GOLDEN}/{number}/{view}", frame)
        for path in (root / GOLDEN).rglob("*"):
            sync(path)
        entries = [{"row": g.row, "prompt": g.prompt, "views": [*g.frames]} for g in rows]
        attributes = zarr.open_group(root, mode="r").attrs.asdict()
        note_metadata(root, attributes | {GOLDEN: entries})


def read_golden(
    root: Path, attributes: Mapping[str, Any], keys: NDArray[np.uint8]
) -> list[GoldenFrames]:
    """The golden rows of a store, whose root has these attributes and whose rows these keys.

    Raises `StoreIncomplete` naming the one that cannot be read or does not give its key.
    """
    entries = enumerate(attributes.get(GOLDEN, []))
    return [_read(root, attributes, number, keys[entry["row"]]) for number, entry in entries]


def carried_golden(
    root: Path, spec: Mapping[str, Any], keys: NDArray[np.uint8]
) -> Iterator[GoldenFrames]:
    """The golden rows of a store that are rows of a build, whose spec and `keys` (row, 16) these
    are; as the first row of that key. What is damaged is left out: the rest prove themselves.
    """
    try:
        check_metadata(root)
    except StoreIncomplete:
        return
    attributes: dict[str, Any] = zarr.open_group(root, mode="r").attrs.asdict()
    for number in range(len(attributes.get(GOLDEN, []))):
        with suppress(StoreIncomplete):
            golden = _unproven(root, attributes, number)
            same = keys == np.frombuffer(golden.key(spec), np.uint8)
            for row in np.flatnonzero(same.all(axis=1))[:1].tolist():
                yield replace(golden, row=row)


def golden_issues(
    root: Path, attributes: Mapping[str, Any], keys: ArraySpec | None
) -> Iterator[Issue]:
    """What is wrong with the golden rows; nothing where the keys themselves cannot be read."""
    if keys is None:
        return
    for number, entry in enumerate(attributes.get(GOLDEN, [])):
        try:
            key = read_rows(root, keys, entry["row"], entry["row"] + 1)[0]
        except StoreIncomplete:
            continue
        try:
            _read(root, attributes, number, key)
        except StoreIncomplete as error:
            yield Issue(severity="error", kind="golden row", message=str(error), stream=GOLDEN)


def golden_files(root: Path, attributes: Mapping[str, Any]) -> set[Path]:
    """The files of the golden rows that a store with these attributes has."""
    if GOLDEN not in attributes:
        return set()
    groups = [root / GOLDEN]
    frames: list[Path] = []
    for number, entry in enumerate(attributes[GOLDEN]):
        groups.append(root / GOLDEN / str(number))
        frames += [groups[-1] / view for view in entry["views"]]
    chunks = {frame / "c" / "0" / "0" / "0" for frame in frames}
    return chunks | {place / "zarr.json" for place in (*groups, *frames)}


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
        config={"write_empty_chunks": True},  # a black frame has a file too
    )
    array[:] = frame


def _read(
    root: Path, attributes: Mapping[str, Any], number: int, key: NDArray[np.uint8]
) -> GoldenFrames:
    """One golden row; `StoreIncomplete` where it cannot be read or does not give the key."""
    golden = _unproven(root, attributes, number)
    if golden.key(attributes["feature_spec"]) != key.tobytes():
        why = f"golden frames and prompt of VL row {golden.row} do not give the key of that row"
        raise StoreIncomplete(f"{root / GOLDEN / str(number)}: {why}. {mend(root)}")
    return golden


def _unproven(root: Path, attributes: Mapping[str, Any], number: int) -> GoldenFrames:
    """One golden row; `StoreIncomplete` where it cannot be read."""
    entry, place = attributes[GOLDEN][number], root / GOLDEN / str(number)
    row, frames = entry["row"], dict[str, NDArray[np.uint8]]()
    for view in entry["views"]:
        try:
            frames[view] = np.asarray(zarr.open_array(place / view, mode="r")[:])
        except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
            why = f"golden frame of VL row {row} cannot be read ({error})"
            raise StoreIncomplete(f"{place / view}: {why}. {mend(root)}") from None
    return GoldenFrames(row, entry["prompt"], frames)
