"""Begin the repair of a damaged store: take over what is sound, lay out anew what is not.

Everything is put together in `<name>.zarr.repair.part`, which becomes `<name>.zarr.part` by one
rename at the end. So a kill leaves the damaged store as it was and nothing half begun, and what
`stages.extract` then completes is a build like any other. The store itself is only read from.
"""

import shutil
from contextlib import closing
from pathlib import Path
from shlex import quote

import numpy as np
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import StoreMismatch
from pipeline.base.files import begin_folder, disk_full_named, remove_folder, sync
from pipeline.base.files import put_in_place as replace_folder
from pipeline.extract.layout import build_arrays, check_space, lay_out
from pipeline.extract.plan import Say
from pipeline.extract.survey import sound_episodes, survey
from pipeline.store import FEATURES, StoreBuild, build_lock, part_path, read_plan, recover
from pipeline.store.chunks import ChunkFiles, read_rows, row_checksums
from pipeline.store.paths import MERGED, STORE, refuse_replaced
from pipeline.store.repair_hints import extract_command, gc_command
from pipeline.store.schema import CHECKSUMS, INCREMENTAL, KEYS, chunk_paths, read_specs
from pipeline.store.verification import Verification, read_arrays
from pipeline.store.writer import environment_runs, sync_folders

_BLOCK_BYTES = 2**26


def repair(verification: Verification, params: Params, say: Say) -> None:
    """Begin a build of the same plan without what is damaged; the store stays as it is meanwhile.

    Damaged feature rows are left out, to be computed again. Where anything else is damaged, it is
    laid out anew from the recordings, which must be those that the store was made of; every sound
    feature row keeps its place. Raises `StoreMismatch` where they are not, or where another build
    is unfinished.
    """
    store = verification.store
    with build_lock(store):
        recover(store)
        plan = read_plan(store) or ""
        part = part_path(store)
        if (unfinished := read_plan(part)) is not None:
            what = "a repair of it has begun" if unfinished == plan else "a build is unfinished"
            raise StoreMismatch(
                f"{part}: {what}. Run {_completed_by(store, unfinished)}, which completes it, or "
                f"remove it: {gc_command(part)}"
            )
        try:
            with disk_full_named(store):
                _begin(verification, plan, params, say)
        except BaseException:
            remove_folder(part_path(_repaired(store)), STORE)
            raise


def layout_is_sound(verification: Verification) -> bool:
    """Whether all that needs no model can be taken over as it is: streams, ticks, episodes."""
    return all(
        issue.stream in INCREMENTAL and issue.chunk is not None for issue in verification.damaged
    )


def copy_layout(store: Path) -> StoreBuild:
    """A build with the metadata of a store, and its chunk files but those written row by row."""
    specs = read_specs(store)
    build = StoreBuild(_repaired(store), specs, read_plan(store) or "")
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
    step = max(1, _BLOCK_BYTES // max(1, spec.row_bytes))
    with closing(ChunkFiles(build.part, spec)) as files:  # which leaves linked chunks as they are
        for chunk, path in enumerate(chunk_paths(store, spec)):
            rows = spec.chunk_rows_of(chunk)
            if chunk not in damaged and sound[rows.start : rows.stop].all():
                files.link(chunk, path)
        for name in INCREMENTAL:
            build.files(name).allocate()
        for environment, run in environment_runs(verification.environments, np.flatnonzero(sound)):
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


def _begin(verification: Verification, plan: str, params: Params, say: Say) -> None:
    store, sound = verification.store, layout_is_sound(verification)
    if not sound:
        say("laying out streams, ticks and episodes again from the recordings")
    with closing(copy_layout(store) if sound else _lay_out_anew(store, plan, params)) as build:
        rows = build.specs[FEATURES].shape[0]
        specs, _ = read_arrays(store)
        readable = all(
            name in specs and specs[name].shape == build.specs[name].shape for name in INCREMENTAL
        )
        carried = carry_rows(store, build, verification) if readable else 0
        put_in_place(build, store)
    say(
        f"{part_path(store)}: a new build, {carried} of {rows} feature rows taken over, "
        f"{rows - carried} to compute"
    )
    say(f"run next: {_completed_by(store, plan)}, which completes it and then replaces the store")


def _lay_out_anew(store: Path, plan: str, params: Params) -> StoreBuild:
    """Everything but the feature rows, from the recordings."""
    with closing(ContentDigests(ledger_path(store))) as digests:
        surveyed, checked = sound_episodes(survey(params, digests), digests)
    if surveyed.plan != plan:
        raise StoreMismatch(
            f"{store}: metadata, streams, ticks or episodes are damaged, and the params describe "
            "another store than this one. Restore its recordings and params, or run "
            f"{_completed_by(store, plan)}, which takes over every row whose frames it knows."
        )
    build = StoreBuild(_repaired(store), build_arrays(checked, surveyed), plan)
    check_space(build, checked, ())
    lay_out(build, checked, surveyed, ())
    return build


def _repaired(store: Path) -> Path:
    """The target under which a build for the repair of this store is put together."""
    return store.with_name(store.name + ".repair")


def _completed_by(store: Path, plan: str) -> str:
    if plan.startswith(MERGED):
        return f"the same python -m stages.store merge --into {quote(str(store))} that made it"
    return extract_command(store)


def _copy(path: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, to)
    sync(to)
