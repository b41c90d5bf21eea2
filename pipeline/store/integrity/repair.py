"""Begin a new build of a damaged store with all that is sound in it.

Everything is put together in `<name>.zarr.repair.part`, which becomes `<name>.zarr.part` by one
rename at the end. So a kill leaves the damaged store as it was and nothing half begun, and what
`stages.extract` then completes is a build like any other. The store itself is only read from.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.durable import disk_full_named, sync
from pipeline.base.ownership import begin_folder, remove_folder
from pipeline.store.chunks import ChunkFiles, row_checksums
from pipeline.store.environments import EnvironmentLog
from pipeline.store.integrity.findings import Findings, runs_of
from pipeline.store.paths import STORE, part_path, read_plan
from pipeline.store.replacement import refuse_replaced
from pipeline.store.schema import (
    CHECKSUMS,
    FEATURES,
    INCREMENTAL,
    KEYS,
    chunk_paths,
    read_specs,
)
from pipeline.store.writer import StoreBuild

_BLOCK_BYTES = 2**26


def repair_build(store: Path) -> Path:
    """The target under which a build for the repair of this store is put together."""
    return store.with_name(store.name + ".repair")


def layout_is_sound(findings: Findings) -> bool:
    """Whether all that needs no model can be taken over as it is: streams, ticks, episodes."""
    return all(one.array in INCREMENTAL and one.chunk is not None for one in findings.damaged)


def copy_layout(store: Path) -> StoreBuild:
    """A build with the metadata of a store, and its sound chunk files but those of features."""
    specs = read_specs(store)
    build = StoreBuild(repair_build(store), specs, read_plan(store) or "")
    with disk_full_named(build.part):
        begin_folder(build.part, STORE)
        for metadata in store.glob("**/zarr.json"):
            place = build.part / metadata.relative_to(store)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(metadata, place)
        others = sorted(set(specs) - set(INCREMENTAL))
        for name in tqdm(others, "take over", unit="array", disable=None, leave=False):
            for chunk, path in enumerate(chunk_paths(store, specs[name])):
                _share(build.files(name), chunk, path)
    return build


def carry_rows(store: Path, build: StoreBuild, findings: Findings) -> int:
    """Take the sound feature rows over, each to its place, and mark them; returns how many.

    Not those whose key lies in a damaged chunk of keys, for a key has no checksum of its own. The
    rows that are not marked are for `stages.extract` to compute. Raises `StoreMismatch` where
    another store took the place of the one that was checked.
    """
    refuse_replaced(store, findings.inode)
    rows = build.specs[FEATURES].shape[0]
    sound = np.ones(rows, np.bool_)
    sound[findings.bad_rows] = False
    for chunk in findings.damaged_chunks(KEYS):
        sound[_slice(build.specs[KEYS].chunk_rows_of(chunk))] = False
    _carry_features(store, build, findings, sound)
    _carry_marks(store, build, findings, sound)
    _carry_environments(store, build)
    for name in INCREMENTAL:
        build.files(name).sync()
    return int(sound.sum())


def put_in_place(build: StoreBuild, store: Path) -> None:
    """Make it the build of the store that `stages.extract` goes on with."""
    build.close()
    for folder in (path for path in [build.part, *build.part.rglob("*")] if path.is_dir()):
        sync(folder)
        if (folder / "zarr.json").exists():
            sync(folder / "zarr.json")
    remove_folder(part_path(store), STORE)  # what has no plan is no build
    build.part.rename(part_path(store))
    sync(store.parent)


def _carry_features(
    store: Path, build: StoreBuild, findings: Findings, sound: NDArray[np.bool_]
) -> None:
    """Link the chunk files in which everything is sound; of the others, copy the sound rows."""
    spec, target = build.specs[FEATURES], build.files(FEATURES)
    source = ChunkFiles(store, spec, writable=False)
    damaged = findings.damaged_chunks(FEATURES)
    _clear(target)
    linked: set[int] = set()
    for chunk, path in enumerate(source.paths):
        whole = chunk not in damaged and sound[_slice(spec.chunk_rows_of(chunk))].all()
        if whole and target.link(chunk, path):
            linked.add(chunk)
    target.allocate()
    for chunk in set(range(spec.chunk_count)) - linked:
        for start, stop in _runs(sound, spec.chunk_rows_of(chunk), _together(build)):
            target.write(start, source.read(start, stop - start))
    source.close()


def _carry_marks(
    store: Path, build: StoreBuild, findings: Findings, sound: NDArray[np.bool_]
) -> None:
    """Copy keys and checksums of the sound rows; a checksum that was lost is taken anew."""
    specs = build.specs
    keys = ChunkFiles(store, specs[KEYS], writable=False)
    checksums = ChunkFiles(store, specs[CHECKSUMS], writable=False)
    lost = findings.damaged_chunks(CHECKSUMS)
    for name in (KEYS, CHECKSUMS):
        _clear(build.files(name))
        build.files(name).allocate()
    for chunk in range(specs[CHECKSUMS].chunk_count):
        for start, stop in _runs(sound, specs[CHECKSUMS].chunk_rows_of(chunk), _together(build)):
            build.files(KEYS).write(start, keys.read(start, stop - start))
            marks = (
                row_checksums(build.files(FEATURES).read(start, stop - start))
                if chunk in lost
                else checksums.read(start, stop - start)
            )
            build.files(CHECKSUMS).write(start, marks)
    keys.close()
    checksums.close()


def _carry_environments(store: Path, build: StoreBuild) -> None:
    log = EnvironmentLog(build.part)
    rows = build.specs[FEATURES].shape[0]
    attributes = json.loads((store / "zarr.json").read_text())["attributes"]
    for noted in attributes.get("environment", []):
        start, stop = noted["rows"]
        if not 0 <= start < stop <= rows:
            continue  # of damaged metadata; what is not noted is only not known
        environment = {name: value for name, value in noted.items() if name != "rows"}
        log.note(start, stop - start, log.index(environment))


def _clear(files: ChunkFiles) -> None:
    """Remove what is there, so that a chunk can be linked or begins with zeros."""
    files.close()
    for path in files.paths:
        path.unlink(missing_ok=True)


def _together(build: StoreBuild) -> int:
    """Rows of features that are held at a time."""
    return max(1, _BLOCK_BYTES // max(1, build.specs[FEATURES].row_bytes))


def _share(files: ChunkFiles, chunk: int, path: Path) -> None:
    """Link a chunk file, or copy it where files cannot be linked."""
    if not files.link(chunk, path):
        files.paths[chunk].parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, files.paths[chunk])
        sync(files.paths[chunk])


def _runs(sound: NDArray[np.bool_], rows: range, most: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of consecutive sound rows among these, in pieces of at most `most`."""
    for first, last in runs_of(rows.start + np.flatnonzero(sound[_slice(rows)])):
        for start in range(first, last + 1, most):
            yield start, min(start + most, last + 1)


def _slice(rows: range) -> slice:
    return slice(rows.start, rows.stop)
