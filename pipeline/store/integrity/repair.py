"""Begin a new build of a damaged store with all that is sound in it.

Everything is put together in `<name>.zarr.repair.part`, which becomes `<name>.zarr.part` by one
rename at the end. So a kill leaves the damaged store as it was and nothing half begun, and what
`stages.extract` then completes is a build like any other. The store itself is only read from.
"""

import shutil
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.durable import disk_full_named, sync
from pipeline.base.durable import put_in_place as replace_folder
from pipeline.base.ownership import begin_folder
from pipeline.store.chunks import ChunkFiles, row_checksums
from pipeline.store.environments import environment_runs
from pipeline.store.integrity.verification import Verification
from pipeline.store.paths import STORE, part_path, read_attributes, read_plan, refuse_replaced
from pipeline.store.schema import (
    FEATURES,
    INCREMENTAL,
    KEYS,
    ArraySpec,
    chunk_paths,
    read_specs,
)
from pipeline.store.writer import StoreBuild, sync_folders

_BLOCK_BYTES = 2**26


def repair_build(store: Path) -> Path:
    """The target under which a build for the repair of this store is put together."""
    return store.with_name(store.name + ".repair")


def layout_is_sound(verification: Verification) -> bool:
    """Whether all that needs no model can be taken over as it is: streams, ticks, episodes."""
    return all(
        issue.stream in INCREMENTAL and issue.chunk is not None for issue in verification.damaged
    )


def copy_layout(store: Path) -> StoreBuild:
    """A build with the metadata of a store, and its chunk files but those written row by row."""
    specs = read_specs(store)
    build = StoreBuild(repair_build(store), specs, read_plan(store) or "")
    with disk_full_named(build.part):
        begin_folder(build.part, STORE)
        for metadata in store.glob("**/zarr.json"):
            _copy(metadata, build.part / metadata.relative_to(store))
        others = sorted(set(specs) - set(INCREMENTAL))
        for name in tqdm(others, "take over", unit="array", disable=None, leave=False):
            files = build.files(name)
            for chunk, path in enumerate(chunk_paths(store, specs[name])):
                if not files.link(chunk, path):
                    _copy(path, files.paths[chunk])
    return build


def carry_rows(store: Path, build: StoreBuild, verification: Verification) -> int:
    """Take the sound feature rows over, each to its place, and mark them; returns how many.

    Not those whose key lies in a damaged chunk of keys, for a key has no checksum of its own. The
    rows that are not marked are for `stages.extract` to compute. Raises `StoreMismatch` where
    another store took the place of the one that was checked.
    """
    refuse_replaced(store, verification.inode)
    sound = np.ones(build.specs[FEATURES].shape[0], np.bool_)
    sound[verification.bad_rows] = False
    for chunk in verification.damaged_chunks(KEYS):
        sound[_slice(build.specs[KEYS].chunk_rows_of(chunk))] = False
    for name in INCREMENTAL:
        build.files(name).close()
        for path in build.files(name).paths:  # of zeros, where it was laid out anew
            path.unlink(missing_ok=True)
    _carry(store, build, verification, sound)
    return int(sound.sum())


def put_in_place(build: StoreBuild, store: Path) -> None:
    """Make it the build of the store that `stages.extract` goes on with."""
    build.close()
    sync_folders(build.part)
    replace_folder(build.part, part_path(store), STORE)


def _carry(
    store: Path, build: StoreBuild, verification: Verification, sound: NDArray[np.bool_]
) -> None:
    """Link the chunk files in which everything is sound; of the others, copy the sound rows."""
    spec, files = build.specs[FEATURES], build.files(FEATURES)
    damaged = verification.damaged_chunks(FEATURES)
    environments = read_attributes(store).get("environment", [])
    with (
        closing(ChunkFiles(store, spec, writable=False)) as features,
        closing(ChunkFiles(store, build.specs[KEYS], writable=False)) as keys,
    ):
        for chunk, path in enumerate(features.paths):
            if chunk not in damaged and sound[_slice(spec.chunk_rows_of(chunk))].all():
                files.link(chunk, path)
        for name in INCREMENTAL:
            build.files(name).allocate()
        for environment, run in environment_runs(environments, np.flatnonzero(sound)):
            number = build.environment_index(environment)
            for block in _blocks(run, spec):
                values = features.read(block.start, len(block))
                if not files.is_linked(block.start // spec.chunk_rows):
                    files.write(block.start, values)
                names = [key.tobytes() for key in keys.read(block.start, len(block))]
                build.mark(block, names, row_checksums(values), number)
        for name in INCREMENTAL:
            build.files(name).sync()


def _copy(path: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, to)
    sync(to)


def _blocks(rows: range, spec: ArraySpec) -> Iterator[range]:
    """These rows in pieces of one chunk each, which memory holds."""
    step, start = max(1, _BLOCK_BYTES // max(1, spec.row_bytes)), rows.start
    while start < rows.stop:
        end_of_chunk = (start // spec.chunk_rows + 1) * spec.chunk_rows
        yield (block := range(start, min(start + step, end_of_chunk, rows.stop)))
        start = block.stop


def _slice(rows: range) -> slice:
    return slice(rows.start, rows.stop)
