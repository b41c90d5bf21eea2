"""Begin the repair of a damaged store: a build of its own plan that lacks the damaged rows.

Sound data are linked or copied into `<name>.zarr.part`; damaged streams, ticks and episodes are
laid out again from the recordings; `stages.extract` computes the missing rows. The plan is written
last: after a kill, the next repair empties the part. The damaged store is only read.
"""

from contextlib import closing
from shlex import quote

import numpy as np
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import StoreMismatch
from pipeline.base.files import disk_full_named, remove_folder
from pipeline.extract.layout import build_arrays, check_space, finish_layout, lay_out
from pipeline.extract.state import Say
from pipeline.extract.survey import sound_episodes, survey
from pipeline.store import FEATURES, StoreBuild, build_lock, part_path, read_plan, recover
from pipeline.store.border import extract_command, gc_command
from pipeline.store.chunks import METADATA_DIGEST, SEAL, ChunkFiles, read_rows, row_checksums
from pipeline.store.golden import GOLDEN
from pipeline.store.paths import (
    MERGED,
    STORE,
    group_attributes,
    refuse_replaced,
    unfinished_plans,
)
from pipeline.store.schema import (
    CHECKSUMS,
    INCREMENTAL,
    KEYS,
    chunk_paths,
    read_spec,
    read_specs,
)
from pipeline.store.verification import Verification, read_arrays
from pipeline.store.writer import environment_runs, sync_folders

_BLOCK_BYTES = 2**26
_NOT_TAKEN = ("plan", METADATA_DIGEST, SEAL, GOLDEN)
"""Attributes of the damaged store that its build writes itself."""


def repair(verification: Verification, params: Params, say: Say) -> None:
    """Begin a build of the same plan without the damaged rows.

    Where more than feature rows is damaged, streams, ticks and episodes are laid out again from the
    recordings; every sound feature row keeps its place. Raises `StoreMismatch` where the recordings
    are not those that the store was made of, or where another build is unfinished.
    """
    store = verification.store
    part = part_path(store)
    with build_lock(store):
        recover(store)
        plan = read_plan(store) or ""
        completed_by = extract_command(store)
        if plan.startswith(MERGED):
            merge = f"python -m stages.store merge --into {quote(str(store))}"
            completed_by = f"the same {merge} that made it"
        if unfinished := unfinished_plans(store):
            what = "a repair of it has begun" if unfinished == [plan] else "a build is unfinished"
            raise StoreMismatch(
                f"{part}: {what}. Run {completed_by}, which completes it, or remove it: "
                f"{gc_command(part)}"
            )
        try:
            with disk_full_named(store):
                if layout_is_sound(verification):
                    rows, carried = begin_from_store(verification)
                else:
                    say("laying out streams, ticks and episodes again from the recordings")
                    rows, carried = _begin_from_recordings(verification, plan, params, completed_by)
                sync_folders(part)
        except BaseException:
            remove_folder(part, STORE)
            raise
    say(
        f"{part}: a new build, {carried} of {rows} feature rows taken over, {rows - carried} to "
        "compute"
    )
    say(f"run next: {completed_by}, which completes it and then replaces the store")


def layout_is_sound(verification: Verification) -> bool:
    """Whether the streams, ticks and episodes can be taken over as they are."""
    return all(
        issue.stream in INCREMENTAL and issue.chunk is not None for issue in verification.damaged
    )


def begin_from_store(verification: Verification) -> tuple[int, int]:
    """Begin the build with the layout of a store, which must be sound, and its sound rows.

    Returns the number of feature rows in the store and the number taken over.
    """
    store = verification.store
    specs = read_specs(store)
    with closing(StoreBuild(store, specs, read_plan(store) or "")) as build:
        build.create()
        others = [name for name in specs if name not in INCREMENTAL]
        for name in tqdm(others, "take over", unit="array", disable=None, leave=False):
            files = build.files(name)
            for chunk, path in enumerate(chunk_paths(store, specs[name])):
                files.link(chunk, path)
            files.allocate()
            for chunk in range(specs[name].chunk_count):
                if not files.is_linked(chunk):
                    rows = specs[name].chunk_rows_of(chunk)
                    files.write(rows.start, read_rows(store, specs[name], rows.start, rows.stop))
        carried = _carry_rows(verification, build)
        attributes = group_attributes(store)
        kept = {name: value for name, value in attributes.items() if name not in _NOT_TAKEN}
        build.finish_layout(kept, group_attributes(store / "vl"))
    return specs[FEATURES].shape[0], carried


def _begin_from_recordings(
    verification: Verification, plan: str, params: Params, completed_by: str
) -> tuple[int, int]:
    """Like `begin_from_store`, but lays out everything except the feature rows anew."""
    store = verification.store
    with closing(ContentDigests(ledger_path(store))) as digests:
        surveyed, checked = sound_episodes(survey(params, digests), digests)
    if surveyed.plan != plan:
        raise StoreMismatch(
            f"{store}: metadata, streams, ticks or episodes are damaged, and the params describe "
            "another store than this one. Restore its recordings and params, or run "
            f"{completed_by}, which takes over every row whose frames it knows."
        )
    with closing(StoreBuild(store, build_arrays(checked, surveyed), plan)) as build:
        check_space(build, checked, ())
        lay_out(build, checked, surveyed, ())
        shapes = {name: spec.shape for name, spec in read_arrays(store)[0].items()}
        readable = all(shapes.get(name) == build.specs[name].shape for name in INCREMENTAL)
        carried = _carry_rows(verification, build) if readable else 0
        finish_layout(build, checked, surveyed)
    return build.specs[FEATURES].shape[0], carried


def _carry_rows(verification: Verification, build: StoreBuild) -> int:
    """Take the sound feature rows over, each in its place, and mark them; returns how many.

    Rows whose key lies in a damaged chunk of keys are left out, because a key has no checksum of
    its own. Raises `StoreMismatch` where another store replaced the one that was checked.
    """
    store = verification.store
    refuse_replaced(store, verification.inode)
    sound = np.ones(build.specs[FEATURES].shape[0], np.bool_)
    sound[verification.bad_rows] = False
    for chunk in verification.damaged_chunks(KEYS):
        rows = build.specs[KEYS].chunk_rows_of(chunk)
        sound[rows.start : rows.stop] = False
    for name in INCREMENTAL:
        build.files(name).close()
        for path in build.files(name).paths:  # all zero if it was laid out anew
            path.unlink(missing_ok=True)
    # Chunk files without damage are linked; from the others, the sound rows are copied.
    spec, damaged = read_spec(store, FEATURES), verification.damaged_chunks(FEATURES)
    # Chunks of stores of schema 1 are larger.
    alike = spec.chunk_rows == build.specs[FEATURES].chunk_rows
    step = max(1, _BLOCK_BYTES // max(1, spec.row_bytes))
    # It does not write to linked chunks.
    with closing(ChunkFiles(build.part, build.specs[FEATURES])) as files:
        for chunk, path in enumerate(chunk_paths(store, spec) if alike else ()):
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
