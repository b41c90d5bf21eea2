"""Recordings x frozen model -> store: survey -> state -> layout -> engine -> seal."""

import errno
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.machine import resolve_device
from pipeline.base.text import capped
from pipeline.data.timeline import rate_notes
from pipeline.extract.engine import Executor, ExtractionReport, compute_here, fill
from pipeline.extract.layout import (
    build_arrays,
    check_readable,
    check_space,
    finish_layout,
    lay_out,
)
from pipeline.extract.rows import keep_golden
from pipeline.extract.state import Say, StorePlaces, count_known, plan_lines, row_sources
from pipeline.extract.survey import (
    MOST_EPISODES,
    CheckedEpisode,
    Survey,
    embodiment_of,
    sound_episodes,
    survey,
)
from pipeline.store import FEATURES, FeatureStore, RowSource, StoreBuild, build_lock, recover
from pipeline.store.paths import refuse_foreign_store


def extract(params: Params, say: Say) -> ExtractionReport | None:
    """Make `extract.store` hold exactly what `params` describe; None where it already does.

    Resumes an interrupted build of the same plan, takes known rows from stores and builds of the
    same feature spec, and computes the rest. With `extract.plan` it only prints what it would do.
    """
    target, only_plan = params.extract.store, params.extract.plan
    with _opened(target, only_plan) as (digests, unwritable):
        places = StorePlaces(target)
        surveyed, checked = _survey(params, digests, places)
        state = places.state(surveyed.plan)
        for line in _survey_lines(surveyed):
            say(line)
        if state == "current":
            FeatureStore.open(target)  # refuses a store that changed after sealing
            if not only_plan and unwritable is None:
                places.drop_previous(surveyed)
            say(f"{target}: up to date, nothing to do (stages.verify reads what it holds)")
            return None
        if unwritable is not None:
            raise unwritable
        resumes = state == "resume"
        build = places.begun_build() if resumes else _new_build(surveyed, checked, places, say)
        with closing(build):
            rows = build.specs[FEATURES].shape[0]
            if resumes:
                missing, known = build.missing(), [RowSource(places.part)]
                taken = rows - len(missing)
            else:
                begun = [] if places.begun is None else [places.part]
                missing, known = np.arange(rows), row_sources([*begun, *places.known], surveyed)
                taken = count_known(checked, surveyed, known)
            for line in plan_lines(build, surveyed, digests, places, state, known, taken):
                say(line)
            if only_plan:
                return None
            if not resumes:
                check_space(build, checked, known)
                if taken < rows:
                    _check_workers(surveyed)
                # From here on, no check refuses the run.
                places = places.set_build_aside(surveyed, say)
                lay_out(build, checked, surveyed, row_sources(places.known, surveyed))
                finish_layout(build, checked, surveyed)
            known = row_sources(places.known, surveyed)
            report = fill(build, surveyed, known, digests, missing, _executor(surveyed))
            keep_golden(build, surveyed, places.stores, say)
            places.put_in_place(build, surveyed, say)
        return report


@contextmanager
def _opened(target: Path, only_plan: bool) -> Generator[tuple[ContentDigests, OSError | None]]:
    """The digests kept beside the store, and the store's lock while the context is open.

    Also the error if nothing can be written there: a store that is up to date needs no write.
    """
    read, unwritable = ContentDigests.to_read, None
    with ExitStack() as stack:
        if only_plan:
            refuse_foreign_store(target)
        else:
            try:
                stack.enter_context(build_lock(target))
                recover(target)
                read = ContentDigests
            except OSError as error:
                if error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM):
                    raise
                unwritable = error
        yield stack.enter_context(closing(read(ledger_path(target)))), unwritable


def _survey(
    params: Params, digests: ContentDigests, places: StorePlaces
) -> tuple[Survey, list[CheckedEpisode]]:
    """The survey; for a new build also its sound episodes, each read completely."""
    surveyed = survey(params, digests)
    if surveyed.bad and params.data.on_bad_episode == "stop":
        sound_episodes(surveyed, digests)  # lists them with everything else that is wrong
    state = places.state(surveyed.plan)
    if state != "current":
        resolve_device(params.extract.device)
    return sound_episodes(surveyed, digests) if state == "new" else (surveyed, [])


def _new_build(
    surveyed: Survey, checked: Sequence[CheckedEpisode], places: StorePlaces, say: Say
) -> StoreBuild:
    """A build of these episodes, of which nothing is written yet; raises where it is refused."""
    places.refuse_to_lose(surveyed, embodiment_of(checked))
    for line in _timeline_lines(surveyed, checked):
        say(line)
    build = StoreBuild(places.target, build_arrays(checked, surveyed), surveyed.plan)
    check_readable(build, checked, surveyed)
    return build


def _check_workers(surveyed: Survey) -> None:
    """Raise `ConfigError` where `extract.workers` is an address that no scheduler answers at."""
    if isinstance(surveyed.extract.workers, str):
        from pipeline.extract.cluster import check_scheduler  # dask: a second to import

        check_scheduler(surveyed.extract.workers)


def _executor(surveyed: Survey) -> Executor:
    """The executor: this process, or the dask workers of `extract.workers`."""
    if surveyed.extract.workers == 0:
        return compute_here
    from pipeline.extract.cluster import compute_on_cluster  # dask: a second to import

    return compute_on_cluster


def _survey_lines(surveyed: Survey) -> Iterator[str]:
    root = surveyed.data.root.absolute()
    for source in surveyed.data.sources:
        if source.hub is not None:
            yield f"source {source.name!r}: {source.hub} is on the Hub, so DVC does not watch it"
        for path in source.paths:
            if Path(path).is_absolute() and not Path(path).is_relative_to(root):
                outside = f"{path} is outside data.root ({surveyed.data.root})"
                yield f"source {source.name!r}: {outside}, so DVC does not watch it"
    missing = [f"not there: {line}" for line in surveyed.missing]
    yield from capped(missing, "episodes that are not there", MOST_EPISODES)
    skipped = [f"skipped {bad.source}: {bad.reason}" for bad in surveyed.bad]
    yield from capped(skipped, "skipped episodes", MOST_EPISODES)


def _timeline_lines(surveyed: Survey, checked: Sequence[CheckedEpisode]) -> Iterator[str]:
    if any(recording.has_poses for recording in surveyed.recordings):
        yield f"actions: rotations as {surveyed.action_rotation}"
    rates = [(ep.source, ep.ticks.recorded_hz, ep.ticks.fastest_hz) for ep in checked]
    for source, note in rate_notes(rates, surveyed.data.action_hz).items():
        yield f"source {source!r}: {note}"
