"""Begin the repair of a damaged store: take over what is sound, lay out anew what is not."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.durable import disk_full_named
from pipeline.base.errors import StoreMismatch
from pipeline.base.ownership import remove_folder
from pipeline.extract.layout import build_arrays, check_space, lay_out
from pipeline.extract.survey import sound_episodes, survey
from pipeline.store import FEATURES, StoreBuild, build_lock, part_path, read_plan, recover
from pipeline.store.integrity import Verification
from pipeline.store.integrity.repair import (
    carry_rows,
    copy_layout,
    layout_is_sound,
    put_in_place,
    repair_build,
)
from pipeline.store.integrity.verification import read_arrays
from pipeline.store.paths import MERGED, STORE
from pipeline.store.repair_hints import extract_command, gc_command
from pipeline.store.schema import INCREMENTAL

Say = Callable[[str], None]


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
            repairs = unfinished == plan
            what = "a repair of it has begun" if repairs else "another build is unfinished"
            raise StoreMismatch(
                f"{part}: {what}. Run {_completed_by(store, unfinished)}, which completes it, or "
                f"remove it: {gc_command(part)}"
            )
        try:
            with disk_full_named(store):
                _begin(verification, plan, params, say)
        except BaseException:
            remove_folder(part_path(repair_build(store)), STORE)
            raise


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
    layout = "taken over as they are" if sound else "written again from the recordings"
    say(
        f"{part_path(store)}: a new build, streams, ticks and episodes {layout}, {carried} of "
        f"{rows} feature rows taken over, {rows - carried} to compute"
    )
    say(f"run next: {_completed_by(store, plan)}, which completes it and then replaces the store")


def _completed_by(store: Path, plan: str) -> str:
    if plan.startswith(MERGED):
        return f"the same python -m stages.store merge --into {store} that made it"
    return extract_command(store)


def _lay_out_anew(store: Path, plan: str, params: Params) -> StoreBuild:
    """Everything but the feature rows, from the recordings."""
    with closing(ContentDigests(ledger_path(store))) as digests:
        surveyed, checked = sound_episodes(survey(params, digests), digests)
    if surveyed.plan != plan:
        raise StoreMismatch(
            f"{store}: metadata, streams, ticks or episodes are damaged, and the params describe "
            "another store than this one (recordings, data, vlm or dtypes changed). Restore the "
            f"recordings and params, or run {_completed_by(store, plan)}, which takes over every "
            "row whose frames it knows."
        )
    build = StoreBuild(repair_build(store), build_arrays(checked, surveyed), plan)
    check_space(build, checked, ())
    lay_out(build, checked, surveyed, ())
    return build
