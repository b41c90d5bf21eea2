"""Recordings x frozen model -> store: the list of steps."""

import errno
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np

from pipeline.base.config import Params
from pipeline.base.device import resolve_device
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.format import capped
from pipeline.data.timeline import rate_notes
from pipeline.extract.engine import Executor, ExtractionReport, compute_here, fill
from pipeline.extract.golden import keep_golden
from pipeline.extract.layout import build_arrays, check_readable, check_space, lay_out
from pipeline.extract.plan import Say, StorePlaces, count_known, plan_lines, row_sources
from pipeline.extract.survey import (
    MOST_EPISODES,
    CheckedEpisode,
    Survey,
    check_episodes,
    embodiment_of,
    sound_episodes,
    survey,
)
from pipeline.store import FEATURES, FeatureStore, RowSource, StoreBuild, build_lock, recover
from pipeline.store.paths import refuse_foreign_store


def extract(params: Params, say: Say) -> ExtractionReport | None:
    """Make `extract.store` hold exactly what `params` describe; None where it does already.

    Resumes an interrupted build of the same plan, takes known rows over from an older store of the
    same feature spec, and computes the rest. With `extract.plan` it only says what it would do.
    """
    with _opened(params.extract.store, params.extract.plan) as (digests, unwritable):
        surveyed, checked = survey(params, digests), list[CheckedEpisode]()
        if surveyed.bad and params.data.on_bad_episode == "stop":
            check_episodes(surveyed)  # lists them with whatever else is wrong
        places = StorePlaces(surveyed.target)
        if not (stands := places.stands(surveyed)):
            resolve_device(params.extract.device)
            surveyed, checked = sound_episodes(surveyed, digests)
            stands = places.stands(surveyed)
        for line in _survey_lines(surveyed):
            say(line)
        if unwritable is not None and (not stands or places.begun == surveyed.plan):
            raise unwritable
        if not stands:
            return _begin(surveyed, checked, places, digests, say)
        if places.begun == surveyed.plan:
            return _resume(surveyed, places, digests, say)
        FeatureStore.open(places.target)  # refuses a store that is not as it was sealed
        say(f"{places.target}: up to date, nothing to do (stages.verify reads what it holds)")
        return None


@contextmanager
def _opened(target: Path, only_plan: bool) -> Generator[tuple[ContentDigests, OSError | None]]:
    """The digests that are remembered beside the store, which nobody else builds meanwhile.

    With the error of what cannot be written there: a store that is up to date needs no writing.
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


def _resume(
    surveyed: Survey, places: StorePlaces, digests: ContentDigests, say: Say
) -> ExtractionReport | None:
    """Go on with the build of this very plan; beside a finished store of it, that is its repair."""
    resolve_device(surveyed.params.extract.device)
    build = places.begun_build()
    with closing(build):
        missing = build.missing()
        done = build.specs[FEATURES].shape[0] - len(missing)
        known = [RowSource(places.part)]
        for line in plan_lines(build, surveyed, digests, places, known, done):
            say(line)
        if surveyed.params.extract.plan:
            return None
        known = row_sources(places.known, surveyed)
        report = fill(build, surveyed, known, digests, missing, _executor(surveyed))
        keep_golden(build, surveyed, places, say)
    places.put_in_place(build, surveyed, say)
    return report


def _begin(
    surveyed: Survey,
    checked: Sequence[CheckedEpisode],
    places: StorePlaces,
    digests: ContentDigests,
    say: Say,
) -> ExtractionReport | None:
    """Begin a new build; what stood in its place is set aside only when nothing can refuse it."""
    extract = surveyed.params.extract
    places.refuse_to_lose(surveyed, embodiment_of(checked))
    for line in _timeline_lines(surveyed, checked):
        say(line)
    build = StoreBuild(places.target, build_arrays(checked, surveyed), surveyed.plan)
    with closing(build):
        check_readable(build, checked, surveyed)
        begun = [] if places.begun is None else [places.part]
        known = row_sources([*begun, *places.known], surveyed)
        taken = count_known(checked, surveyed, known)
        for line in plan_lines(build, surveyed, digests, places, known, taken):
            say(line)
        if extract.plan:
            return None
        check_space(build, checked, known)
        rows = np.arange(build.specs[FEATURES].shape[0])
        if isinstance(extract.workers, str) and taken < len(rows):
            from pipeline.extract.cluster import check_scheduler  # dask: a second to import

            check_scheduler(extract.workers)
        places.make_room(surveyed, say)
        places = StorePlaces(places.target)
        known = row_sources(places.known, surveyed)
        lay_out(build, checked, surveyed, known)
        report = fill(build, surveyed, known, digests, rows, _executor(surveyed))
        keep_golden(build, surveyed, places, say)
    places.put_in_place(build, surveyed, say)
    return report


def _executor(surveyed: Survey) -> Executor:
    """Where rows are computed: in this process, or by the dask workers of `extract.workers`."""
    if surveyed.params.extract.workers == 0:
        return compute_here
    from pipeline.extract.cluster import compute_on_cluster  # dask: a second to import

    return compute_on_cluster


def _survey_lines(surveyed: Survey) -> Iterator[str]:
    for source in surveyed.params.data.sources:
        for path in source.paths:
            if Path(path).is_absolute():
                yield f"source {source.name!r}: {path} is absolute, so DVC does not watch it"
    missing = [f"not there: {line}" for line in surveyed.missing]
    yield from capped(missing, "episodes that are not there", MOST_EPISODES)
    depth = {(one.source, view) for one in surveyed.recordings for view in one.depth_views()}
    for source, view in sorted(depth):
        yield f"source {source!r}: view {view} is a depth map, no picture, and is left out"
    skipped = [f"skipped {bad.source}: {bad.reason}" for bad in surveyed.bad]
    yield from capped(skipped, "skipped episodes", MOST_EPISODES)


def _timeline_lines(surveyed: Survey, checked: Sequence[CheckedEpisode]) -> Iterator[str]:
    if any(recording.has_poses for recording in surveyed.recordings):
        yield f"actions: rotations as {surveyed.action_rotation}"
    rates = [(one.source, one.ticks.recorded_hz, one.ticks.fastest_hz) for one in checked]
    for source, note in rate_notes(rates, surveyed.params.data.action_hz).items():
        yield f"source {source!r}: {note}"
