"""Begin the repair of a damaged store: take over what is sound, lay out anew what is not."""

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.durable import disk_full_named
from pipeline.base.errors import StoreMismatch
from pipeline.base.ownership import remove_folder
from pipeline.extract.layout import build_arrays, check_space, lay_out
from pipeline.extract.survey import sound_episodes, survey
from pipeline.store import FEATURES, StoreBuild, build_lock, part_path, read_plan, recover
from pipeline.store.integrity.findings import Damage, Findings
from pipeline.store.integrity.repair import (
    carry_rows,
    copy_layout,
    layout_is_sound,
    put_in_place,
    repair_build,
)
from pipeline.store.integrity.structure import read_arrays
from pipeline.store.paths import MERGED, STORE
from pipeline.store.repair_hints import extract_command, gc_command
from pipeline.vlm.feature_spec import document_digest


@dataclass(frozen=True)
class Repair:
    """What was begun."""

    part: Path
    rows: int
    carried: int
    """Feature rows that were taken over as they were."""
    laid_out_anew: bool
    """Streams, ticks and episodes were written again from the recordings."""
    completed_by: str
    """The command."""

    def lines(self) -> list[str]:
        """For people."""
        layout = (
            "streams, ticks and episodes written again from the recordings"
            if self.laid_out_anew
            else "streams, ticks and episodes taken over as they are"
        )
        return [
            f"{self.part}: a new build, {layout}, {self.carried} of {self.rows} feature rows taken "
            f"over, {self.rows - self.carried} to compute",
            f"run next: {self.completed_by}, which completes it and then replaces the store",
        ]


def repair(findings: Findings, params: Params, say: Callable[[str], None]) -> Repair:
    """Begin a build of the same plan without what is damaged; the store stays as it is meanwhile.

    Damaged feature rows are left out, to be computed again. Where anything else is damaged, it is
    laid out anew from the recordings, which must be those that the store was made of; every sound
    feature row keeps its place. Raises `StoreMismatch` where they are not, or where another build
    is unfinished, and `StoreIncomplete` where the store no longer says what it holds.
    """
    store = findings.store
    with build_lock(store):
        recover(store)
        plan = read_plan(store)
        assert plan is not None, "a store was checked there"
        _refuse_other_build(store, plan)
        try:
            with disk_full_named(store):
                return _begin(findings, plan, params, say)
        except BaseException:
            remove_folder(part_path(repair_build(store)), STORE)
            raise


def _begin(findings: Findings, plan: str, params: Params, say: Callable[[str], None]) -> Repair:
    store, sound = findings.store, layout_is_sound(findings)
    if sound:
        build = copy_layout(store)
    else:
        say("laying out streams, ticks and episodes again from the recordings")
        build = _lay_out_anew(store, plan, params)
    with closing(build):
        carried = carry_rows(store, build, findings) if _rows_can_be_read(store, build) else 0
        put_in_place(build, store)
    rows = build.specs[FEATURES].shape[0]
    return Repair(part_path(store), rows, carried, not sound, _completed_by(store, plan))


def with_identity(findings: Findings) -> Findings:
    """The findings, and whether the feature spec of the store is the one that its digest names."""
    if "" in findings.damaged_arrays():
        return findings  # the attributes cannot be relied on, as is said already
    place = findings.store / "zarr.json"
    spec = json.loads(place.read_text())["attributes"]["feature_spec"]
    expected = document_digest(spec)
    if spec.get("digest") == expected:
        return findings
    what = f"expected the digest {expected} of its feature_spec, found {spec.get('digest')}"
    return replace(findings, damaged=(*findings.damaged, Damage("", None, place, what)))


def _completed_by(store: Path, plan: str) -> str:
    if plan.startswith(MERGED):
        return f"the same python -m stages.store merge --into {store} that made it"
    return extract_command(store)


def _refuse_other_build(store: Path, plan: str) -> None:
    unfinished = read_plan(part_path(store))
    if unfinished is None:
        return
    what = "a repair of it has begun" if unfinished == plan else "another build is unfinished"
    raise StoreMismatch(
        f"{part_path(store)}: {what}. Run {_completed_by(store, unfinished)}, which completes it, "
        f"or remove it: {gc_command(part_path(store))}"
    )


def _lay_out_anew(store: Path, plan: str, params: Params) -> StoreBuild:
    """Everything but the feature rows, from the recordings."""
    with closing(ContentDigests(ledger_path(store))) as digests:
        surveyed, checked = sound_episodes(survey(params, digests), digests)
    if surveyed.plan != plan:
        raise StoreMismatch(
            f"{store}: metadata, streams, ticks or episodes are damaged, and the params describe "
            "another store than this one (recordings, data, vlm or dtypes changed), so that they "
            "cannot be written again. Restore the recordings and params, or run "
            f"{_completed_by(store, plan)}, which takes over every row whose frames it knows."
        )
    build = StoreBuild(repair_build(store), build_arrays(checked, surveyed), plan)
    check_space(build, checked, ())
    lay_out(build, checked, surveyed, ())
    return build


def _rows_can_be_read(store: Path, build: StoreBuild) -> bool:
    """Whether the arrays of feature rows are there and are as the build's."""
    found, _ = read_arrays(store)
    needed = ("vl/features", "vl/key", "vl/checksum", "vl/slot_valid")
    return all(name in found and found[name].shape == build.specs[name].shape for name in needed)
