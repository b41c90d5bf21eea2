"""A compressed, sharded, checksummed copy of a store, for keeping and sharing.

It is a plain zarr v3 group with the same arrays under the same names, but in a few large files
(shards). Inner chunks of some MB are compressed and checksummed one by one, so that a part can be
read without the rest. A shard holds whole chunk files of the store, so that both copies are read
and written once, in order, with one shard in memory at a time.

Its root has the attributes of the store and a manifest: the text of every `zarr.json` of the store,
including its seal with the checksum of each chunk file. The manifest proves the archive and is
enough to rebuild every byte of the store. It is written last: a folder with a manifest is a
complete archive.
"""

import hashlib
import json
import math
import re
import shutil
from collections.abc import Generator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any, TypeVar

import google_crc32c
import numpy as np
import zarr
from numpy.typing import NDArray
from pydantic import Field
from tqdm import tqdm
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec
from zarr.storage import LocalStore, StorePath

from pipeline.base.border import Border, Document, Text, shown
from pipeline.base.digests import file_digest
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
from pipeline.store.border import (
    Group,
    Length,
    StoreAttributes,
    extract_command,
    gc_command,
    store_border,
)
from pipeline.store.chunks import (
    METADATA_DIGEST,
    SEAL,
    Seal,
    check_seal,
    check_trailers,
    read_rows,
    sealed_trailer,
)
from pipeline.store.golden import GOLDEN, read_golden
from pipeline.store.lock import build_lock
from pipeline.store.paths import (
    STORE,
    group_attributes,
    inode_of,
    part_path,
    recover,
    refuse_replaced,
    unfinished_plans,
)
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import (
    ARRAY_NAMES,
    GROUPS,
    KEYS,
    TRAILER_BYTES,
    ArraySpec,
    array_of,
    check_agreement,
    chunk_paths,
    read_specs,
)
from pipeline.store.writer import StoreBuild, sync_folders

_SCHEMA = 2
_ZARR_JSON = "zarr.json"

# The attribute of the root that holds the manifest.
_MANIFEST = "archive"

# Attributes of a store's root that would be wrong in an archive.
_OF_A_STORE = ("schema", "plan", METADATA_DIGEST, SEAL)

# Most raw bytes of a shard and of an inner chunk, unless one chunk file of the store, or one row,
# is larger. They are part of the format: to change them, change `_SCHEMA`.
SHARD_BYTES = 256 * 2**20
INNER_BYTES = 4 * 2**20

# The offset that a shard's index gives for a piece of zeros, which is not stored.
_NO_PIECE = 2**64 - 1

# The names that files of a store can have; none leads out of its folder.
_ARRAY = rf"^({'|'.join(ARRAY_NAMES)})$"
_VIEW = r"golden/[0-9]+/[^/.\x00][^/\x00]*"
_FRAME = rf"^{_VIEW}/c/0/0/0$"
_METADATA = rf"^(({'|'.join((*GROUPS, *ARRAY_NAMES))}|golden|golden/[0-9]+|{_VIEW})/)?zarr\.json$"

_BORDER = Border(
    StoreIncomplete,
    "Nothing was restored from it; take another copy of the archive, or make it anew with "
    "stages.archive where the store still is.",
)
_Model = TypeVar("_Model")


class ArchivedArray(Document):
    """One array in the manifest.

    `raw_bytes` counts the bytes of its rows, `shard_bytes` those of each shard's file: 0 where all
    values are zero, because zarr then writes no file. `metadata` is the digest of the array's
    metadata in the archive.
    """

    codec: Text
    raw_bytes: Length
    shard_bytes: list[Length]
    metadata: Text


class Manifest(Document):
    """The content of an archive.

    `metadata` has the text of every `zarr.json` of the store by path. `golden` has the digest of
    each chunk file of the golden rows, which are copied unchanged.
    """

    metadata: dict[Annotated[str, Field(pattern=_METADATA)], str]
    arrays: dict[Annotated[str, Field(pattern=_ARRAY)], ArchivedArray] = Field(
        min_length=len(ARRAY_NAMES)
    )
    golden: dict[Annotated[str, Field(pattern=_FRAME)], Text] = Field(default_factory=dict)

    def attributes(self, archive: Path) -> StoreAttributes:
        """The root attributes of the store. Raises `StoreIncomplete` where they are wrong."""
        return StoreAttributes.of(archive, self._parsed(archive, "", Group).attributes, _BORDER)

    def specs(self, archive: Path) -> dict[str, ArraySpec]:
        """The arrays of the store. Raises `StoreIncomplete` where their metadata are wrong."""
        specs: dict[str, ArraySpec] = {}
        for name in self.arrays:
            document = self._parsed(archive, name, dict[str, Any])
            where = f"{archive}, {name}/zarr.json of the store"
            specs[name] = array_of(document, name, where, _BORDER)
        check_agreement(archive, self.attributes(archive), specs, _BORDER)
        return specs

    def _parsed(self, archive: Path, place: str, model: type[_Model]) -> _Model:
        path = f"{place}/{_ZARR_JSON}".lstrip("/")
        where = f"{archive}, {path} of the store"
        return _BORDER.parse_json(self.metadata.get(path, ""), model, where)

    @property
    def raw_bytes(self) -> int:
        """Bytes of the rows of all arrays."""
        return sum(array.raw_bytes for array in self.arrays.values())

    @property
    def stored_bytes(self) -> int:
        """Bytes of all shards."""
        return sum(sum(array.shard_bytes) for array in self.arrays.values())


def is_archive(path: Path) -> bool:
    """Whether a complete archive lies at `path`; reads only the group's metadata."""
    return _manifest_document(path) is not None


ARCHIVE = OutputKind("an archive of a store", is_archive)


def read_manifest(path: Path) -> Manifest:
    """The manifest of an archive.

    Raises `StoreMismatch` where there is something else, `StoreIncomplete` where it is damaged.
    """
    document = _manifest_document(path)
    if document is None:
        instead = f"no manifest in its {_ZARR_JSON}" if path.exists() else "nothing"
        raise StoreMismatch(
            f"{path}: expected an archive, found {instead}. Name one with archive.output, or make "
            "it with stages.archive."
        )
    if document.get("schema") != _SCHEMA:
        raise StoreMismatch(
            f"{path / _ZARR_JSON}: expected an archive of schema {_SCHEMA}, found "
            f"{shown(document.get('schema'))}. Restore it with the version that made it."
        )
    if document.pop("digest", None) != _digest_of(document):
        raise _damaged(path / _ZARR_JSON, "its manifest does not give its digest")
    return _BORDER.parse(document, Manifest, path / _ZARR_JSON)


def archive(store: Path, output: Path, level: int, threads: int) -> Manifest | None:
    """Write the archive of a finished store to `output` and prove that it gives the store back.

    `level` is zstd's, 1 to 22. The store is checked first, and every shard is read back after it is
    written. The archive is written in `<output>.part`; after a kill it starts again from nothing.
    Returns None if `output` already is an archive of this store.

    Raises `StoreIncomplete`, which names the file, where the store is not finished or is damaged,
    `StoreMismatch` where something else lies at `output`, `StoreLocked` and `DiskFull`.
    """
    opened = FeatureStore.open(store)  # its error says what is wrong with the store
    with build_lock(output):
        if output.exists():
            if is_archive(output) and _holds(read_manifest(output), store):
                return None
            raise StoreMismatch(
                f"{output}: there already, and not an archive of {store} as it is now. Move it "
                "away, or name another place with archive.output."
            )
        refuse_foreign(output, ARCHIVE)  # a link to nothing
        check_trailers(store)
        read_golden(store, opened.array(KEYS))
        with _new_part(output, ARCHIVE, threads) as part:
            manifest = _write(store, part, level, opened.attrs[SEAL])
        put_in_place(part, output, ARCHIVE)
        return manifest


def restore(archive: Path, target: Path, threads: int) -> None:
    """Make the store of an archive again, equal in every byte of every file.

    It is built in `<target>.part` like any store and renamed when complete; after a kill it starts
    again from nothing. If `target` already is that store, nothing is done.

    Raises `StoreIncomplete`, which names file and array, where the archive is damaged,
    `StoreMismatch` where another store lies at `target` or is being built there, `ConfigError`
    where something else lies there, `StoreLocked` and `DiskFull`.
    """
    manifest = read_manifest(archive)
    with build_lock(target):
        recover(target)
        if target.exists():
            if not _holds(manifest, target):
                raise StoreMismatch(
                    f"{target}: there already, and not the archived store. It was left as it is: "
                    "remove or rename it, or restore to another place with archive.store."
                )
            check_trailers(target)
            return
        _refuse_build(target)
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


def _write(store: Path, part: Path, level: int, seal: Seal) -> Manifest:
    """Write all of an archive to the disk, its manifest last."""
    inode, specs, metadata = inode_of(store), read_specs(store), _read_metadata(store)
    root = {k: v for k, v in group_attributes(store).items() if k not in _OF_A_STORE}
    for name in GROUPS:
        zarr.create_group(part, path=name, attributes=group_attributes(store / name))
    with _progress("archive", sum(spec.data_bytes for spec in specs.values())) as progress:
        arrays = {
            name: _write_array(store, part, spec, level, seal, progress)
            for name, spec in specs.items()
        }
    golden = _golden_digests(store)
    _write_metadata(part, {n: text for n, text in metadata.items() if n.startswith(GOLDEN)})
    _copy_golden(store, part, golden)
    refuse_replaced(store, inode)
    manifest = Manifest(metadata=metadata, arrays=arrays, golden=golden)
    document = {"schema": _SCHEMA, **manifest.model_dump(mode="json")}
    document["digest"] = _digest_of(document)
    zarr.open_group(part, mode="a").attrs.put({**root, _MANIFEST: document})
    sync_folders(part)
    return manifest


def _write_array(
    store: Path, part: Path, spec: ArraySpec, level: int, seal: Seal, progress: "tqdm[Any]"
) -> ArchivedArray:
    """Copy an array shard by shard; read each shard back and compare it with the seal."""
    array = _create_array(part, spec, level)
    sizes: list[int] = []
    for shard, rows in _shards(part, spec, array):
        array[rows.start : rows.stop] = read_rows(store, spec, rows.start, rows.stop)
        if shard.exists():
            sync(shard)
        _read_shard(array, spec, shard, rows, seal)
        sizes.append(shard.stat().st_size if shard.exists() else 0)
        progress.update(len(rows) * spec.row_bytes)
    return ArchivedArray(
        codec=f"zstd+{codec_for(spec.dtype, 0, level).shuffle.value}",
        raw_bytes=spec.data_bytes,
        shard_bytes=sizes,
        metadata=file_digest(part / spec.name / _ZARR_JSON),
    )


def _rebuild(manifest: Manifest, archive: Path, target: Path, part: Path) -> None:
    specs, root = manifest.specs(archive), manifest.attributes(archive)
    _write_metadata(part, {n: text for n, text in manifest.metadata.items() if n != _ZARR_JSON})
    with closing(StoreBuild(target, specs, root.plan)) as build:
        build.allocate()
        with _progress("restore", manifest.raw_bytes) as progress:
            for name, record in manifest.arrays.items():
                array = _open_array(archive, specs[name], record)
                for shard, rows in _shards(archive, specs[name], array):
                    _check_shard(shard, array)
                    values = _read_shard(array, specs[name], shard, rows, root.seal)
                    build.write(name, rows.start, values)
                    progress.update(values.nbytes)
                build.files(name).write_trailers()
        build.close()
        _copy_golden(archive, part, manifest.golden)
        sync_folders(part)
        # The root's attributes hold the plan. With them the folder looks like an extraction's
        # unfinished build, which no later restoration may remove; so they are written last.
        _write_metadata(part, {_ZARR_JSON: manifest.metadata[_ZARR_JSON]})
        sync(part / _ZARR_JSON)
        sync(part)
        try:
            check_seal(part, root.seal, specs)
        except StoreIncomplete as error:
            raise _damaged(archive / _ZARR_JSON, str(error)) from None
        build.put_in_place()


def _read_shard(
    array: "zarr.Array[Any]", spec: ArraySpec, shard: Path, rows: range, seal: Seal | None
) -> NDArray[Any]:
    """The rows of a shard; raises `StoreIncomplete` where they differ from the sealed ones."""
    try:
        values = np.ascontiguousarray(array[rows.start : rows.stop])
    except (ValueError, RuntimeError) as error:
        raise _damaged(shard, f"{spec.name} cannot be read: {error}") from None
    for start in range(rows.start, rows.stop, spec.chunk_rows):
        inside = values[start - rows.start :][: spec.chunk_rows]
        crc = google_crc32c.value(inside.reshape(-1).view(np.uint8))
        crc = google_crc32c.extend(crc, bytes(spec.chunk_bytes - inside.nbytes))
        chunk = start // spec.chunk_rows
        if crc.to_bytes(TRAILER_BYTES, "little") != sealed_trailer(seal, spec.name, chunk):
            where = f"rows {start} to {start + len(inside) - 1} of {spec.name}"
            raise _damaged(shard, f"{where} are other ones")
    return values


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


def _open_array(archive: Path, spec: ArraySpec, record: ArchivedArray) -> "zarr.Array[Any]":
    """An array of an archive; raises `StoreIncomplete` where its metadata were changed."""
    metadata = archive / spec.name / _ZARR_JSON
    if not metadata.is_file() or file_digest(metadata) != record.metadata:
        raise _damaged(metadata, f"missing, or not the metadata that were written of {spec.name}")
    written: Any = _create_array({}, spec, level=1).metadata  # any level unpacks any other
    folder = StorePath(LocalStore(archive, read_only=True), spec.name)
    return zarr.Array(zarr.AsyncArray(written, folder))


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


def _holds(manifest: Manifest, store: Path) -> bool:
    """Whether an archive is of this store: its metadata, with the seal, and golden rows agree."""
    return _read_metadata(store) == manifest.metadata and _golden_digests(store) == manifest.golden


def _golden_digests(store: Path) -> dict[str, str]:
    """The digest of each chunk file of a store's golden rows, by path in the store."""
    paths = sorted(path for path in (store / GOLDEN).rglob("*") if path.is_file())
    names = {path.relative_to(store).as_posix(): path for path in paths}
    return {name: file_digest(path) for name, path in names.items() if re.fullmatch(_FRAME, name)}


def _copy_golden(root: Path, to: Path, digests: Mapping[str, str]) -> None:
    """Copy the chunk files of golden rows.

    Raises `StoreIncomplete` where one is missing or does not give its digest.
    """
    for name in digests:
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        _BORDER.check_file(root / name)
        shutil.copyfile(root / name, to / name)
        if file_digest(to / name) != digests[name]:
            raise _damaged(root / name, "a golden frame is another one than was written")
        sync(to / name)


def _refuse_build(target: Path) -> None:
    """Refuse an unfinished build of any plan: it may hold rows that exist nowhere else."""
    part = part_path(target)
    if unfinished_plans(target):
        raise StoreMismatch(
            f"{part}: expected nothing there, found an unfinished build. Finish it with "
            f"{extract_command(target)}, remove it with {gc_command(part)}, or set archive.store."
        )


def _read_metadata(store: Path) -> dict[str, str]:
    """Every `zarr.json` of a store as text, by path in the store."""
    names = {path.relative_to(store).as_posix(): path for path in sorted(store.rglob(_ZARR_JSON))}
    known = {name: path for name, path in names.items() if re.fullmatch(_METADATA, name)}
    return {name: store_border(store).read_bytes(path).decode() for name, path in known.items()}


def _write_metadata(root: Path, texts: Mapping[str, str]) -> None:
    for name, text in texts.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")


def _progress(label: str, total: int) -> "tqdm[Any]":
    return tqdm(total=total, unit="B", unit_scale=True, desc=label, disable=None)


def _manifest_document(path: Path) -> dict[str, Any] | None:
    document = group_attributes(path).get(_MANIFEST)
    return document if isinstance(document, dict) else None


def _digest_of(body: Mapping[str, Any]) -> str:
    text = json.dumps(body, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _damaged(path: Path, why: str) -> PipelineError:
    """The error for a changed or broken file of an archive."""
    return _BORDER.refusal(path, f"the archive is damaged: {why}")
