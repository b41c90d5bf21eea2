"""Begin a new build of a damaged store with all that is sound in it.

Everything is put together in `<name>.zarr.repair.part`, which becomes `<name>.zarr.part` by one
rename at the end. So a kill leaves the damaged store as it was and nothing half begun, and what
`stages.extract` then completes is a build like any other. The store itself is only read from.
"""

import shutil
from contextlib import closing
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.base.durable import disk_full_named, sync
from pipeline.base.durable import put_in_place as replace_folder
from pipeline.base.ownership import begin_folder
from pipeline.store.chunks import ChunkFiles, read_rows, row_checksums
from pipeline.store.environments import environment_runs
from pipeline.store.integrity.verification import Verification
from pipeline.store.paths import STORE, part_path, read_attributes, read_plan, refuse_replaced
from pipeline.store.schema import CHECKSUMS, FEATURES, INCREMENTAL, KEYS, chunk_paths, read_specs
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
        rows = build.specs[KEYS].chunk_rows_of(chunk)
        sound[rows.start : rows.stop] = False
    for name in INCREMENTAL:
        build.files(name).close()
        for path in build.files(name).paths:  # of zeros, where it was laid out anew
            path.unlink(missing_ok=True)
    # Chunk files in which everything is sound are linked; of the others, sound rows are copied.
    spec, damaged = build.specs[FEATURES], verification.damaged_chunks(FEATURES)
    environments = read_attributes(store).get("environment", [])
    step = max(1, _BLOCK_BYTES // max(1, spec.row_bytes))
    with closing(ChunkFiles(build.part, spec)) as files:  # which leaves linked chunks as they are
        for chunk, path in enumerate(chunk_paths(store, spec)):
            rows = spec.chunk_rows_of(chunk)
            if chunk not in damaged and sound[rows.start : rows.stop].all():
                files.link(chunk, path)
        for name in INCREMENTAL:
            build.files(name).allocate()
        for environment, run in environment_runs(environments, np.flatnonzero(sound)):
            number = build.environment_index(environment)
            for start in range(run.start, run.stop, step):
                rows = run[start - run.start :][:step]
                values = read_rows(store, spec, start, rows.stop)
                files.write(start, values)
                keys = read_rows(store, build.specs[KEYS], start, rows.stop)
                build.mark(rows, [*map(bytes, keys)], row_checksums(values), number)
        files.sync()
    build.files(CHECKSUMS).sync()
    return int(sound.sum())


def put_in_place(build: StoreBuild, store: Path) -> None:
    """Make it the build of the store that `stages.extract` goes on with."""
    build.close()
    sync_folders(build.part)
    replace_folder(build.part, part_path(store), STORE)


def _copy(path: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, to)
    sync(to)
