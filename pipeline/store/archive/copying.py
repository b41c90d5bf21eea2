"""A finished store -> its archive."""

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.durable import disk_full_named, put_in_place, sync
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.ownership import begin_folder, remove_folder
from pipeline.store.archive.codecs import Choice, Codec, choose, codecs_for
from pipeline.store.archive.layout import create_array, inner_rows, rows_of, shard_path, shards
from pipeline.store.archive.manifest import (
    ARCHIVE,
    ATTRIBUTE,
    ROOT,
    ArchivedArray,
    Manifest,
    file_digest,
    is_archive,
    read_manifest,
    read_metadata,
)
from pipeline.store.archive.report import ArchiveReport
from pipeline.store.archive.source import (
    all_rows,
    checked_rows,
    chunk_crcs,
    samples,
    trailer,
)
from pipeline.store.chunks import check_row_checksums
from pipeline.store.lock import build_lock
from pipeline.store.metadata import ATTRIBUTE as METADATA_DIGEST
from pipeline.store.metadata import check_metadata
from pipeline.store.paths import inode_of, part_path, refuse_replaced
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import CHECKSUMS, FEATURES, ArraySpec, chunk_paths, read_specs

SAMPLES = 4
"""Inner chunks of an array that its codec is chosen by."""
_WORTH = 0.01
"""Share of the store that a codec outside of zarr's specification must save."""
_OF_A_STORE = ("schema", "plan", METADATA_DIGEST)
"""Attributes of the root that would be false of an archive."""


def archive(store: Path, output: Path, level: int, threads: int) -> ArchiveReport:
    """Write the archive of a finished store to `output` and prove that it gives the store back.

    Each array's codec is chosen by measuring on samples of it; `level` is zstd's, 1 to 22. Every
    shard is read back and compared. What is written lies in `<output>.part` until it is complete;
    stopped or killed, it is begun anew. An archive of this very store that is there already is
    left alone.

    Raises `StoreIncomplete` where the store is not finished or is damaged (array, file and rows
    named), `StoreMismatch` where something else lies at `output`, `StoreLocked` and `DiskFull`.
    """
    begun = time.perf_counter()
    FeatureStore.open(store)  # says what is wrong with something that is no finished store
    check_metadata(store)
    with build_lock(output):
        if output.exists():
            return ArchiveReport(output, _archived_already(store, output).arrays, None)
        part = part_path(output)
        try:
            with disk_full_named(output), zarr.config.set({"async.concurrency": threads}):
                arrays = _write(store, part, level)
        except BaseException:
            remove_folder(part, ARCHIVE)
            raise
        put_in_place(part, output, ARCHIVE)
    return ArchiveReport(output, arrays, time.perf_counter() - begun)


def _archived_already(store: Path, output: Path) -> Manifest:
    """The manifest at `output`, where it is of this store as it is now."""
    if is_archive(output):
        manifest = read_manifest(output)
        trailers = {
            name: tuple(trailer(path) for path in chunk_paths(store, spec))
            for name, spec in read_specs(store).items()
        }
        archived = {name: array.crc32c for name, array in manifest.arrays.items()}
        if manifest.metadata == read_metadata(store) and archived == trailers:
            return manifest
    raise StoreMismatch(
        f"{output}: there already, and not an archive of {store} as it is now. Move it away, or "
        "name another place with archive.output."
    )


def _write(store: Path, part: Path, level: int) -> dict[str, ArchivedArray]:
    """Everything of an archive, its manifest last, all of it on the disk."""
    begin_folder(part, ARCHIVE)
    inode, metadata, specs = inode_of(store), read_metadata(store), read_specs(store)
    checksums = all_rows(store, specs[CHECKSUMS])
    total = sum(spec.data_bytes for spec in specs.values())
    _create_groups(part, metadata)
    arrays: dict[str, ArchivedArray] = {}
    with tqdm(total=total, unit="B", unit_scale=True, desc="archive", disable=None) as progress:
        for name, spec in specs.items():
            progress.set_postfix_str(name)
            choice = _choice(store, spec, level, total)
            of_rows = checksums if name == FEATURES else None
            arrays[name] = _write_array(store, part, spec, choice, of_rows, progress)
    refuse_replaced(store, inode)
    group = zarr.open_group(part, mode="r+")
    group.attrs.put({**group.attrs.asdict(), ATTRIBUTE: Manifest(metadata, arrays).document()})
    for place, _, files in os.walk(part):
        if ROOT in files:  # shards were synced as they were written
            sync(Path(place, ROOT))
        sync(Path(place))
    return arrays


def _create_groups(part: Path, metadata: Mapping[str, str]) -> None:
    """The groups with their attributes."""
    for path in sorted(metadata, key=lambda path: path.count("/")):  # parents first
        document = json.loads(metadata[path])
        if document["node_type"] == "group":
            attributes = document.get("attributes", {})
            if path == ROOT:
                attributes = {k: v for k, v in attributes.items() if k not in _OF_A_STORE}
            name = path.removesuffix(ROOT).rstrip("/")
            zarr.create_group(part, path=name, attributes=attributes)


def _choice(store: Path, spec: ArraySpec, level: int, store_bytes: int) -> Choice:
    """The codec of an array; one without data has nothing to choose by."""
    if not spec.data_bytes:
        return Choice(Codec("none"), {})
    rows = inner_rows(spec)
    candidates = codecs_for(spec.dtype, len(spec.shape), rows * spec.row_bytes, level)
    worth = _WORTH * store_bytes / spec.data_bytes
    return choose(samples(store, spec, rows, SAMPLES), candidates, worth)


def _write_array(
    store: Path,
    part: Path,
    spec: ArraySpec,
    choice: Choice,
    checksums: NDArray[np.uint32] | None,
    progress: "tqdm[Any]",
) -> ArchivedArray:
    """One array, shard by shard, each compared with what it gives back before the next.

    `checksums` are those of feature rows.
    """
    array = create_array(part, spec, choice.codec)
    sizes: list[int] = []
    crcs: list[int] = []
    for shard, chunks in enumerate(shards(spec, array)):
        path = shard_path(part, array, shard)
        crcs += _write_shard(store, array, path, spec, chunks, checksums)
        sizes.append(path.stat().st_size if path.exists() else 0)
        progress.update(len(rows_of(spec, chunks)) * spec.row_bytes)
    digest = file_digest(part / spec.name / ROOT)
    return ArchivedArray(
        choice.codec.name, choice.ratios, spec.data_bytes, tuple(sizes), tuple(crcs), digest
    )


def _write_shard(
    store: Path,
    array: "zarr.Array[Any]",
    path: Path,
    spec: ArraySpec,
    chunks: range,
    checksums: NDArray[np.uint32] | None,
) -> list[int]:
    """One shard, on the disk and read back; the checksum of each chunk file that it holds."""
    values, crcs = checked_rows(chunk_paths(store, spec), spec, chunks)
    rows = rows_of(spec, chunks)
    if checksums is not None:
        wanted = checksums[rows.start : rows.stop]
        check_row_checksums(store, spec, rows.start, values, wanted)
    array[rows.start : rows.stop] = values
    del values  # a shard may be large: what is read back takes its place
    if path.exists():
        sync(path)
    if chunk_crcs(spec, chunks, np.ascontiguousarray(array[rows.start : rows.stop])) != crcs:
        raise StoreIncomplete(
            f"{path}: does not give back the rows of {spec.name} that were written. Check the "
            "disk, then run stages.archive again."
        )
    return crcs
