"""An archive -> the store, to the byte."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.durable import disk_full_named, sync
from pipeline.base.errors import StoreMismatch
from pipeline.base.ownership import begin_folder, remove_folder
from pipeline.store.archive.layout import open_array, rows_of, shard_path, shards
from pipeline.store.archive.manifest import (
    ROOT,
    ArchivedArray,
    Manifest,
    damaged,
    file_digest,
    read_manifest,
    read_metadata,
)
from pipeline.store.archive.source import checked_rows, chunk_crcs
from pipeline.store.lock import build_lock
from pipeline.store.paths import STORE, part_path, read_plan, recover
from pipeline.store.repair_hints import extract_command, gc_command
from pipeline.store.schema import ArraySpec, chunk_paths, read_specs
from pipeline.store.writer import StoreBuild


def restore(archive: Path, target: Path, threads: int) -> None:
    """Make the store that an archive was made from, equal in every byte of every file.

    Built in `<target>.part` like any store and renamed when complete; stopped or killed, it is
    begun anew. Where that very store is there already, nothing is done.

    Raises `StoreIncomplete` naming file and array where the archive is damaged, `StoreMismatch`
    where another store lies at `target` or is being built there, `ConfigError` where something
    else does, `StoreLocked` and `DiskFull`.
    """
    manifest = read_manifest(archive)
    with build_lock(target):
        recover(target)
        if target.exists():
            return _check_same(manifest, target)
        _check_no_build(target)
        part = part_path(target)
        try:
            with disk_full_named(target), zarr.config.set({"async.concurrency": threads}):
                _build(manifest, archive, target)
        except BaseException:
            remove_folder(part, STORE)
            raise


def _build(manifest: Manifest, archive: Path, target: Path) -> None:
    part = part_path(target)
    begin_folder(part, STORE)
    for name, text in manifest.metadata.items():
        if name != ROOT:
            _write_text(part / name, text)
    build = StoreBuild(target, read_specs(part), manifest.plan or "")
    try:
        build.allocate()
        with _progress("restore", manifest) as progress:
            for name, record in manifest.arrays.items():
                _restore_array(archive, build, name, record, progress)
        build.finish()
        # With the root's attributes, which hold the plan, it is what an extraction would go on
        # with, or an earlier one have left, and so nothing that another restoration may remove.
        _write_text(part / ROOT, manifest.metadata[ROOT])
        sync(part / ROOT)
        sync(part)
        build.put_in_place()
    finally:
        build.close()


def _restore_array(
    archive: Path, build: StoreBuild, name: str, record: ArchivedArray, progress: "tqdm[Any]"
) -> None:
    """One array, shard by shard, each proven to be what was archived before it is written."""
    spec, array = build.specs[name], _checked_array(archive, name, record)
    for shard, chunks in enumerate(shards(spec, array)):
        rows = rows_of(spec, chunks)
        path = shard_path(archive, array, shard)
        crcs = record.crc32c[chunks.start : chunks.stop]
        build.write(name, rows.start, _checked_shard(array, path, spec, chunks, crcs))
        progress.update(len(rows) * spec.row_bytes)
    build.files(name).write_trailers()


def _checked_shard(
    array: "zarr.Array[Any]", path: Path, spec: ArraySpec, chunks: range, crcs: Sequence[int]
) -> NDArray[Any]:
    """The rows of one shard.

    Raises `StoreIncomplete` where the shard, or what is decoded of it, is not what was written.
    """
    rows = rows_of(spec, chunks)
    try:
        values = np.ascontiguousarray(array[rows.start : rows.stop])
    except (ValueError, RuntimeError) as error:
        raise damaged(path, f"{spec.name} cannot be read: {error}") from None
    if chunk_crcs(spec, chunks, values) != list(crcs):
        raise damaged(path, f"rows {rows.start} to {rows.stop - 1} of {spec.name} are other ones")
    return values


def _checked_array(root: Path, name: str, record: ArchivedArray) -> "zarr.Array[Any]":
    """An array of an archive whose files all have the sizes that they were written with.

    Raises `StoreIncomplete` naming the file that has not.
    """
    metadata = root / name / ROOT
    if not metadata.exists():
        raise damaged(metadata, f"the file is missing, and with it {name}")
    if file_digest(metadata) != record.metadata:
        raise damaged(metadata, f"the metadata of {name} are not those that were written")
    array = open_array(root, name)
    for index, wanted in enumerate(record.shard_bytes):
        path = shard_path(root, array, index)
        found = path.stat().st_size if path.exists() else 0
        if found != wanted:
            raise damaged(path, f"expected {wanted} bytes of {name}, found {found}")
    return array


def _check_same(manifest: Manifest, target: Path) -> None:
    """Raise `StoreMismatch` unless the store at `target` is the archived one, to the byte."""
    different = StoreMismatch(
        f"{target}: there already, and not the archived store. It was left as it is: remove or "
        "rename it, or restore to another place with archive.store."
    )
    if read_metadata(target) != manifest.metadata:
        raise different
    with _progress("compare", manifest) as progress:
        for name, spec in read_specs(target).items():
            paths = chunk_paths(target, spec)
            for chunk in range(spec.chunk_count):
                if not paths[chunk].exists():
                    raise different
                values, crcs = checked_rows(paths, spec, range(chunk, chunk + 1))
                if crcs[0] != manifest.arrays[name].crc32c[chunk]:
                    raise different
                progress.update(values.nbytes)


def _check_no_build(target: Path) -> None:
    """An unfinished extraction or repair may hold rows that exist nowhere else, of any plan."""
    part = part_path(target)
    if read_plan(part) is not None:
        raise StoreMismatch(
            f"{part}: expected nothing there, found an unfinished build. Finish it with "
            f"{extract_command(target)}, remove it with {gc_command(part)}, or restore to another "
            "place with archive.store."
        )


def _progress(what: str, manifest: Manifest) -> "tqdm[Any]":
    total = sum(record.raw_bytes for record in manifest.arrays.values())
    return tqdm(total=total, unit="B", unit_scale=True, desc=what, disable=None)


def _write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode())
