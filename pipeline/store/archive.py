"""A compressed, sharded, checksummed copy of a store, for keeping and sharing.

It is a plain zarr v3 group with the same arrays under the same names, but in a few large files
(shards). Inner chunks of some MB are compressed and checksummed one by one, so that a part can be
read without the rest. A shard holds whole chunk files of the store, so that both copies are read
and written once, in order, with one shard in memory at a time.

Its root has the attributes of the store and, written last, the text of every `zarr.json` of the
store. These rebuild every byte of it, and the seal in them proves what was restored.
"""

import math
import shutil
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray
from pydantic import Field
from tqdm import tqdm
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec
from zarr.storage import LocalStore, StorePath

from pipeline.base.documents import Border, Document
from pipeline.base.errors import PipelineError, StoreIncomplete, StoreMismatch
from pipeline.base.files import (
    OutputKind,
    begin_folder,
    disk_full_named,
    put_in_place,
    refuse_foreign,
    remove_folder,
    sync,
)
from pipeline.store.chunks import METADATA_DIGEST, SEAL, check_seal, check_trailers, read_rows
from pipeline.store.documents import (
    Group,
    StoreAttributes,
    extract_command,
    gc_command,
    mend,
    store_border,
)
from pipeline.store.golden_rows import golden_places, read_golden
from pipeline.store.lock import build_lock
from pipeline.store.paths import STORE, group_attributes, part_path, recover, unfinished_plans
from pipeline.store.paths import put_in_place as put_store_in_place
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import (
    ARRAY_NAMES,
    GROUPS,
    KEYS,
    ArraySpec,
    array_of,
    check_agreement,
    chunk_paths,
    read_specs,
)
from pipeline.store.writer import StoreBuild, sync_folders

_SCHEMA = 3

# The attribute of the root that holds the manifest.
_MANIFEST = "archive"

# Attributes of a store's root that would be wrong in an archive.
_OF_A_STORE = ("schema", "plan", METADATA_DIGEST, SEAL)

# Most raw bytes of a shard and of an inner chunk, unless one chunk file of the store, or one row,
# is larger. They are part of the format: to change them, change `_SCHEMA`.
SHARD_BYTES = 256 * 2**20
INNER_BYTES = 4 * 2**20

# Most bytes of the file of a golden frame, which holds 2**13 x 2**13 pixels at most.
_MOST_FRAME_BYTES = 2**28

# The offset that a shard's index gives for a piece of zeros, which is not stored.
_NO_PIECE = 2**64 - 1

_BORDER = Border(
    StoreIncomplete,
    "Nothing was restored from it; take another copy of the archive, or make it anew with "
    "stages.archive where the store still is.",
)


class Manifest(Document):
    """The content of an archive: the text of every `zarr.json` of the store, by folder."""

    version: Literal[2, 3] = Field(alias="schema")
    metadata: dict[str, str]

    def attributes(self, archive: Path) -> StoreAttributes:
        """The root attributes of the store. Raises `StoreIncomplete` where they are wrong."""
        group = _BORDER.parse_json(self.text(archive, ""), Group, archive / "zarr.json")
        return StoreAttributes.of(archive, group.attributes, _BORDER)

    def specs(self, archive: Path) -> dict[str, ArraySpec]:
        """The arrays of the store. Raises `StoreIncomplete` where their metadata are wrong."""
        specs: dict[str, ArraySpec] = {}
        for name in ARRAY_NAMES:
            where = f"{archive}, {name}/zarr.json of the store"
            document = _BORDER.parse_json(self.text(archive, name), dict[str, Any], where)
            specs[name] = array_of(document, name, where, _BORDER)
        check_agreement(archive, self.attributes(archive), specs, _BORDER)
        return specs

    def text(self, archive: Path, place: str) -> str:
        """The text of the `zarr.json` in a folder of the store."""
        name = f"{place}/zarr.json".lstrip("/")
        if name not in self.metadata:
            raise _damaged(archive / "zarr.json", f"it lacks {name} of the store")
        return self.metadata[name]


def is_archive(path: Path) -> bool:
    """Whether a complete archive lies at `path`; reads only the group's metadata."""
    return _MANIFEST in group_attributes(path)


ARCHIVE = OutputKind("an archive of a store", is_archive)


def read_manifest(path: Path) -> Manifest:
    """The manifest of an archive.

    Raises `StoreMismatch` where there is something else, `StoreIncomplete` where it is damaged or
    of another version.
    """
    if not is_archive(path):
        instead = "no manifest in its zarr.json" if path.exists() else "nothing"
        raise StoreMismatch(
            f"{path}: expected an archive, found {instead}. Name one with archive.output, or make "
            "it with stages.archive."
        )
    return _BORDER.parse(group_attributes(path)[_MANIFEST], Manifest, path / "zarr.json")


def archive(store: Path, output: Path, level: int, threads: int) -> int | None:
    """Write the archive of a finished store to `output`; returns how many bytes of rows it holds.

    `level` is zstd's, 1 to 22. The store is checked first, and every shard is read back after it is
    written. The archive is written in `<output>.part`; after a kill it starts again from nothing.
    Returns None if `output` already is an archive of this store.

    Raises `StoreIncomplete`, which names the file, where the store is not finished or is damaged,
    `StoreMismatch` where something else lies at `output`, `StoreLocked` and `DiskFull`.
    """
    opened = FeatureStore.open(store)  # its error says what is wrong with the store
    with build_lock(output):
        metadata = _metadata_of(store)
        if output.exists():
            if is_archive(output) and read_manifest(output).metadata == metadata:
                return None
            raise StoreMismatch(
                f"{output}: there already, and not an archive of {store} as it is now. Move it "
                "away, or name another place with archive.output."
            )
        refuse_foreign(output, ARCHIVE)  # a link to nothing
        check_trailers(store)
        read_golden(store, opened.array(KEYS))
        with _new_part(output, ARCHIVE, threads) as part:
            specs = read_specs(store)
            total = sum(spec.data_bytes for spec in specs.values())
            for name in GROUPS:
                zarr.create_group(part, path=name, attributes=group_attributes(store / name))
            with _progress("archive", total) as bar:
                for spec in specs.values():
                    _write_array(store, part, spec, level, bar)
            _copy_golden(store, part, StoreAttributes.of(store, dict(opened.attrs)))
            if _metadata_of(store) != metadata:
                raise StoreMismatch(f"{store}: another store took its place. Archive it again.")
            _write_metadata(store, part, metadata)
        put_in_place(part, output, ARCHIVE)
        return total


def restore(archive: Path, target: Path, threads: int) -> None:
    """Make the store of an archive again, equal in every byte of every file.

    It is built in `<target>.part` like any store and renamed when complete; after a kill it starts
    again from nothing. If `target` already is that store, nothing is done.

    Raises `StoreIncomplete`, which names the file, where the archive is damaged, `StoreMismatch`
    where another store lies at `target` or is being built there, `ConfigError` where something else
    lies there, `StoreLocked` and `DiskFull`.
    """
    manifest = read_manifest(archive)
    with build_lock(target):
        recover(target)
        if target.exists():
            if _metadata_of(target) != manifest.metadata:
                raise StoreMismatch(
                    f"{target}: there already, and not the archived store. It was left as it is: "
                    "remove or rename it, or restore to another place with archive.store."
                )
            check_trailers(target)
            return
        if unfinished_plans(target):  # it may hold rows that exist nowhere else
            part = part_path(target)
            raise StoreMismatch(
                f"{part}: expected nothing there, found an unfinished build. Finish it with "
                f"{extract_command(target)}, remove it with {gc_command(part)}, or set "
                "archive.store."
            )
        with _new_part(target, STORE, threads) as part:
            _rebuild(manifest, archive, target, part)


@contextmanager
def _new_part(target: Path, kind: OutputKind, threads: int) -> Generator[Path]:
    """A new folder beside `target`; it is removed if the work in it fails."""
    part = part_path(target)
    try:
        with disk_full_named(target), zarr.config.set({"async.concurrency": threads}):
            begin_folder(part, kind)
            yield part
    except BaseException:
        remove_folder(part, kind)
        raise


def _write_array(
    store: Path, part: Path, spec: ArraySpec, level: int, progress: "tqdm[Any]"
) -> None:
    """Copy an array shard by shard, and read each shard back."""
    array = _create_array(part, spec, level)
    for shard, rows in _shards(part, spec, array):
        values = read_rows(store, spec, rows.start, rows.stop)
        array[rows.start : rows.stop] = values
        if shard.exists():
            sync(shard)
        if _read_shard(array, shard, rows).tobytes() != values.tobytes():
            raise _damaged(shard, "the disk did not keep what was written")
        progress.update(values.nbytes)


def _write_metadata(store: Path, part: Path, metadata: dict[str, str]) -> None:
    """Write the metadata of golden rows and, last, of the root; waits for the disk."""
    for name in metadata:
        if name.startswith("golden"):
            (part / name).write_text(metadata[name], encoding="utf-8")
    root = {k: v for k, v in group_attributes(store).items() if k not in _OF_A_STORE}
    manifest = {"schema": _SCHEMA, "metadata": metadata}
    zarr.open_group(part, mode="a").attrs.put({**root, _MANIFEST: manifest})
    sync_folders(part)


def _rebuild(manifest: Manifest, archive: Path, target: Path, part: Path) -> None:
    specs, root = manifest.specs(archive), manifest.attributes(archive)
    with closing(StoreBuild(target, specs, root.plan)) as build:
        build.allocate()
        total = sum(spec.data_bytes for spec in specs.values())
        with _progress("restore", total) as progress:
            for name, spec in specs.items():
                for rows, values in _archived_rows(archive, spec):
                    build.write(name, rows.start, values)
                    progress.update(values.nbytes)
                build.files(name).write_trailers()
        _copy_golden(archive, part, root)
        # The root's attributes hold the plan. With them the folder looks like an extraction's
        # unfinished build, which no later restoration may remove; so they are written last.
        for place in (*GROUPS, *ARRAY_NAMES, *golden_places(root), ""):
            if not place:
                sync_folders(part)
            path = part / place / "zarr.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(manifest.text(archive, place), encoding="utf-8")
        sync(part / "zarr.json")
        sync(part)
        try:
            check_seal(part, root.seal, specs)
            read_golden(part, read_rows(part, specs[KEYS]))
        except StoreIncomplete as error:
            raise _damaged(archive, str(error).removesuffix(f". {mend(part)}")) from None
        put_store_in_place(target)


def _archived_rows(archive: Path, spec: ArraySpec) -> Iterator[tuple[range, NDArray[Any]]]:
    """The rows of an array of an archive, shard by shard.

    Its own metadata are not read: the store's say how it was written.
    """
    written: Any = _create_array({}, spec, level=1).metadata  # any level unpacks any other
    folder = StorePath(LocalStore(archive, read_only=True), spec.name)
    array: zarr.Array[Any] = zarr.Array(zarr.AsyncArray(written, folder))
    for shard, rows in _shards(archive, spec, array):
        _check_shard(shard, array)
        yield rows, _read_shard(array, shard, rows)


def _read_shard(array: "zarr.Array[Any]", shard: Path, rows: range) -> NDArray[Any]:
    """The rows of a shard; raises `StoreIncomplete` where they cannot be read."""
    try:
        return np.ascontiguousarray(array[rows.start : rows.stop])
    except (ValueError, RuntimeError) as error:
        raise _damaged(shard, f"{array.path} cannot be read: {error}") from None


def _create_array(root: Path | dict[str, Any], spec: ArraySpec, level: int) -> "zarr.Array[Any]":
    """The array in an archive, without data."""
    # As few shards as possible; all but the last have the same size.
    most = max(1, SHARD_BYTES // max(1, spec.chunk_bytes))
    chunks = math.ceil(spec.chunk_count / max(1, math.ceil(spec.chunk_count / most))) or 1
    shard, inner = chunks * spec.chunk_rows, inner_rows(spec)
    widths = tuple(max(1, size) for size in spec.shape[1:])
    codec = codec_for(spec.dtype, inner * spec.row_bytes, level)
    return spec.create(
        root, shards=(shard, *widths), chunks=(inner, *widths), compressors=[codec, Crc32cCodec()]
    )


def codec_for(dtype: np.dtype[Any], chunk_bytes: int, level: int) -> BloscCodec:
    """The codec of inner chunks of `chunk_bytes`; `level` is zstd's, 1 to 22.

    `python -m benchmarks.compression` compares this rule with other codecs: A-scans and features in
    float32 and float16 are smallest with shuffled bytes; clocks, row numbers and bfloat16 (as
    integers) with shuffled bits. Blosc gets the whole chunk as one block: in blocks of its own
    choice, features take a tenth more.
    """
    shuffle = BloscShuffle.shuffle
    if dtype.itemsize == 1:
        shuffle = BloscShuffle.noshuffle
    elif dtype.kind in "iu" or dtype.itemsize == 8:
        shuffle = BloscShuffle.bitshuffle
    # Blosc's levels 1 to 9 run zstd at levels 1, 3, 5, …, 15 and 22.
    clevel = 9 if level >= 22 else min(8, (level + 1) // 2)
    return BloscCodec(cname="zstd", clevel=clevel, shuffle=shuffle, blocksize=chunk_bytes)


def inner_rows(spec: ArraySpec) -> int:
    """Rows per inner chunk: the most that divide a store's chunk and fit `INNER_BYTES`."""
    parts = min(spec.chunk_rows, max(1, math.ceil(spec.chunk_bytes / INNER_BYTES)))
    return spec.chunk_rows // next(part for part in count(parts) if not spec.chunk_rows % part)


def _shards(root: Path, spec: ArraySpec, array: "zarr.Array[Any]") -> list[tuple[Path, range]]:
    """The file of each shard of an array with data, and the rows in it."""
    assert array.shards is not None, "an archive is sharded"
    cut = replace(spec, stored_chunk_rows=array.shards[0])
    return [(path, cut.chunk_rows_of(shard)) for shard, path in enumerate(chunk_paths(root, cut))]


def _check_shard(shard: Path, array: "zarr.Array[Any]") -> None:
    """Raise `StoreIncomplete` where a piece of a shard claims another unpacked size."""
    if not shard.exists():
        return  # all zero
    assert array.shards is not None, "an archive is sharded"
    whole = math.prod(array.chunks) * array.dtype.itemsize
    pieces = array.shards[0] // array.chunks[0]
    size = _BORDER.check_file(shard, (pieces + 1) * (whole + 64))  # zarr reads it whole
    with shard.open("rb") as file:
        file.seek(max(0, size - 16 * pieces - 4))
        index = np.frombuffer(file.read(16 * pieces), "<u8", min(size, 16 * pieces) // 16 * 2)
        for begin, length in index.reshape(-1, 2).tolist():
            if begin < _NO_PIECE:
                file.seek(min(begin, size) + 4)  # where Blosc keeps the unpacked size
                if begin + length > size or int.from_bytes(file.read(4), "little") != whole:
                    raise _damaged(
                        shard, f"{array.path} cannot be read: a piece is not {whole} bytes"
                    )


def _copy_golden(root: Path, to: Path, attributes: StoreAttributes) -> None:
    """Copy the chunk files of golden rows, which prove themselves by their keys."""
    for place in golden_places(attributes):
        (to / place).mkdir(parents=True, exist_ok=True)
        if place.count("/") == 2:
            chunk = Path(place, "c", "0", "0", "0")
            _BORDER.check_file(root / chunk, _MOST_FRAME_BYTES)
            (to / chunk).parent.mkdir(parents=True)
            shutil.copyfile(root / chunk, to / chunk)
            sync(to / chunk)


def _metadata_of(store: Path) -> dict[str, str]:
    """Every `zarr.json` of a store as text, by path in the store; the seal is among them."""
    border, attributes = store_border(store), group_attributes(store)
    golden = golden_places(StoreAttributes.of(store, attributes))
    texts: dict[str, str] = {}
    for place in ("", *GROUPS, *ARRAY_NAMES, *golden):
        path = store / place / "zarr.json"
        texts[path.relative_to(store).as_posix()] = border.read_bytes(path).decode()
    return texts


def _progress(label: str, total: int) -> "tqdm[Any]":
    return tqdm(total=total, unit="B", unit_scale=True, desc=label, disable=None)


def _damaged(path: Path, why: str) -> PipelineError:
    """The error for a changed or broken file of an archive."""
    return _BORDER.refusal(path, f"the archive is damaged: {why}")
