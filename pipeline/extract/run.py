"""Recordings x frozen model -> store."""

from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np

from pipeline.base.config import Params
from pipeline.base.device import resolve_device
from pipeline.base.digests import ContentDigests
from pipeline.base.durable import free_bytes
from pipeline.data.timeline import rate_notes
from pipeline.extract.check import CheckedEpisode, check_episodes, embodiment_of
from pipeline.extract.fill import ExtractionReport, fill, rate_name
from pipeline.extract.layout import build_arrays, check_space, lay_out
from pipeline.extract.places import (
    Say,
    donors_at,
    keeping_note,
    known_places,
    layout_damage,
    ledger_path,
    make_room,
    plans,
    put_in_place,
    refuse_to_lose,
)
from pipeline.extract.plan import (
    ExtractionPlan,
    dtype_warnings,
    known_rows,
    reasons,
    store_bytes,
    warnings,
)
from pipeline.extract.survey import Survey, survey
from pipeline.store import (
    FeatureStore,
    RowSource,
    StoreBuild,
    build_lock,
    part_path,
    read_plan,
    recover,
)
from pipeline.store.metadata import check_metadata
from pipeline.store.paths import refuse_foreign_store
from pipeline.store.schema import read_specs


def extract(params: Params, say: Say) -> ExtractionReport | None:
    """Make `extract.store` hold exactly what `params` describe; None where it does already.

    Resumes an interrupted build of the same plan, takes known rows over from an older store of the
    same feature spec, and computes the rest. With `extract.plan` it only says what it would do.
    """
    target = params.extract.store
    with ExitStack() as stack:
        if params.extract.plan:
            refuse_foreign_store(target)
            digests = ContentDigests.to_read(ledger_path(target))
        else:
            stack.enter_context(build_lock(target))
            recover(target)
            digests = ContentDigests(ledger_path(target))
        stack.enter_context(closing(digests))
        surveyed = survey(params, digests)
        if surveyed.bad and params.data.on_bad_episode == "stop":
            check_episodes(surveyed, params)  # lists them with whatever else is wrong
        if _can_go_on(surveyed, target):
            return _go_on(surveyed, params, digests, say)
        resolve_device(params.extract.device)
        surveyed, checked = sound_episodes(surveyed, params, digests)
        if _can_go_on(surveyed, target):
            return _go_on(surveyed, params, digests, say)
        _say_survey(surveyed, params, say)
        return _begin(surveyed, checked, params, digests, say)


def _can_go_on(surveyed: Survey, target: Path) -> bool:
    """Whether a store or a build of this very plan is there; a build, as it was laid out."""
    begun, finished = plans(target)
    if begun == surveyed.plan:
        return layout_damage(target) is None
    return finished == surveyed.plan


def _go_on(
    surveyed: Survey, params: Params, digests: ContentDigests, say: Say
) -> ExtractionReport | None:
    """Complete what was begun; beside a finished store of the same plan, that is its repair."""
    target = params.extract.store
    _say_survey(surveyed, params, say)
    if read_plan(part_path(target)) == surveyed.plan:
        return _resume(surveyed, params, digests, say)
    FeatureStore.open(target)  # refuses a store that files are missing from
    check_metadata(target)
    say(f"{target}: up to date, nothing to do (stages.verify reads what it holds)")
    return None


def sound_episodes(
    surveyed: Survey, params: Params, digests: ContentDigests
) -> tuple[Survey, list[CheckedEpisode]]:
    """Every sound episode; the survey again without those that have to be skipped.

    A bad episode must decide neither the views nor how actions are derived.
    """
    checked, bad = check_episodes(surveyed, params)
    if not bad:
        return surveyed, checked
    for one, reason in bad:
        digests.note_bad(one.digest, reason)
    again = survey(params, digests)
    if again.action_rotation == surveyed.action_rotation:
        kept = {one.digest for one in again.episodes}
        return again, [one for one in checked if one.surveyed.digest in kept]
    return sound_episodes(again, params, digests)


def _resume(
    surveyed: Survey, params: Params, digests: ContentDigests, say: Say
) -> ExtractionReport | None:
    """Go on with the build of this very plan."""
    target = params.extract.store
    resolve_device(params.extract.device)
    build = StoreBuild(target, read_specs(part_path(target)), surveyed.plan)
    repairs = read_plan(target) == surveyed.plan
    reason = "completing the repair" if repairs else "continuing the interrupted build"
    with closing(build), donors_at(known_places(target), surveyed) as donors:
        missing = build.missing()
        rows, episodes = (build.specs[name].shape[0] for name in ("vl/time", "episode/source"))
        plan = ExtractionPlan(
            episodes=episodes,
            unchanged=episodes,
            rows=rows,
            known=rows - len(missing),
            variants=surveyed.spec.variants,
            bytes=store_bytes(build.specs),
            free=free_bytes(build.part),
            rows_per_s=digests.rate(rate_name(surveyed, params)),
            reasons=(f"{reason} {build.part}",),
            warnings=dtype_warnings(params, len(missing)),
        )
        for line in [*plan.lines(), *keeping_note(target, surveyed)]:
            say(line)
        if params.extract.plan:
            return None
        report = fill(build, surveyed, donors, params, digests, missing)
    put_in_place(build, surveyed, say)
    return report


def _begin(
    surveyed: Survey,
    checked: Sequence[CheckedEpisode],
    params: Params,
    digests: ContentDigests,
    say: Say,
) -> ExtractionReport | None:
    """Begin a new build; what stood in its place is set aside only when nothing can refuse it."""
    target, part = params.extract.store, part_path(params.extract.store)
    refuse_to_lose(target, surveyed, embodiment_of(checked))
    keeping = keeping_note(target, surveyed)
    build = StoreBuild(target, build_arrays(checked, surveyed, params), surveyed.plan)
    if any(one.recording.has_poses for one in surveyed.episodes):
        say(f"actions: rotations as {surveyed.action_rotation}")
    rates = [
        (one.surveyed.recording.source, one.timeline.recorded_hz, one.timeline.fastest_hz)
        for one in checked
    ]
    for source, note in rate_notes(rates, params.data.action_hz).items():
        say(f"source {source!r}: {note}")
    with closing(build):
        with donors_at([part, *known_places(target)], surveyed) as donors:
            plan = _new_plan(build, checked, surveyed, donors, params, digests)
            for line in [*plan.lines(), *keeping]:
                say(line)
            if params.extract.plan:
                return None
            check_space(build, checked, donors)
        if isinstance(params.extract.workers, str) and plan.known < plan.rows:
            from pipeline.extract.connection import check_scheduler  # dask: a second to import

            check_scheduler(params.extract)
        make_room(target, surveyed, say)
        with donors_at(known_places(target), surveyed) as donors:
            lay_out(build, checked, surveyed, params, donors)
            everything = np.arange(plan.rows)
            report = fill(build, surveyed, donors, params, digests, everything)
    put_in_place(build, surveyed, say)
    return report


def _new_plan(
    build: StoreBuild,
    checked: Sequence[CheckedEpisode],
    surveyed: Survey,
    donors: Sequence[RowSource],
    params: Params,
    digests: ContentDigests,
) -> ExtractionPlan:
    before = {digest for donor in donors for digest in donor.episode_digests}
    before_it = build.target if build.target in known_places(build.target) else build.part
    store = RowSource(before_it) if read_plan(before_it) is not None else None
    rows = build.specs["vl/time"].shape[0]
    known = known_rows(checked, surveyed.spec.views, donors)
    return ExtractionPlan(
        episodes=len(checked),
        unchanged=sum(one.surveyed.digest in before for one in checked),
        rows=rows,
        known=known,
        variants=surveyed.spec.variants,
        bytes=store_bytes(build.specs),
        free=free_bytes(build.part),
        rows_per_s=digests.rate(rate_name(surveyed, params)),
        reasons=_reasons(build, surveyed, store),
        warnings=(*warnings(surveyed, store, params.data), *dtype_warnings(params, rows - known)),
    )


def _reasons(build: StoreBuild, surveyed: Survey, store: RowSource | None) -> tuple[str, ...]:
    if read_plan(build.part) == surveyed.plan and (damage := layout_damage(build.target)):
        return (f"{damage}; streams are laid out again, the feature rows are kept",)
    return reasons(surveyed, store, build.specs)


def _say_survey(surveyed: Survey, params: Params, say: Say) -> None:
    for source in params.data.sources:
        for path in source.paths:
            if Path(path).is_absolute():
                say(f"source {source.name!r}: {path} is absolute, so DVC does not watch it")
    for line in surveyed.missing:
        say(f"not there: {line}")
    recordings = [one.recording for one in surveyed.episodes]
    depth = {(one.source, view) for one in recordings for view in one.depth_views()}
    for source, view in sorted(depth):
        say(f"source {source!r}: view {view} is a depth map, no picture, and is left out")
    for bad in surveyed.bad:
        say(f"skipped {bad.source}: {bad.reason}")
