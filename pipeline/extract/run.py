"""Recordings x frozen model -> store: survey -> state -> layout -> engine -> seal."""

from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import StoreMismatch
from pipeline.base.hardware import resolve_device
from pipeline.base.text import capped
from pipeline.data.timeline import rate_notes
from pipeline.extract.build_state import (
    BuildState,
    Say,
    StorePlaces,
    count_known,
    plan_lines,
    row_sources,
)
from pipeline.extract.engine import Executor, ExtractionReport, compute_here, fill
from pipeline.extract.rows import keep_golden
from pipeline.extract.streams import build_arrays, check_space, lay_out
from pipeline.extract.survey import (
    MOST_EPISODES,
    CheckedEpisode,
    Survey,
    embodiment_of,
    sound_episodes,
    survey,
)
from pipeline.store import FEATURES, FeatureStore, RowSource, StoreBuild, build_lock, recover
from pipeline.store.documents import extract_command
from pipeline.store.paths import refuse_foreign_store


def extract(params: Params, say: Say, repair: bool = False) -> ExtractionReport | None:
    """Make `extract.store` hold exactly what `params` describe; None where it already does.

    Resumes an interrupted build of the same plan, takes known rows from stores and builds of the
    same feature spec, and computes the rest. With `extract.plan` it only prints what it would do. A
    `repair` makes a store of these very params again and takes its sound rows.
    """
    target, only_plan = params.extract.store, params.extract.plan
    with _opened(target, only_plan) as digests:
        places = StorePlaces(target)
        surveyed, checked, state = _survey(params, digests, places, repair, say)
        for line in _survey_lines(surveyed):
            say(line)
        if state == "current":
            FeatureStore.open(target)  # refuses a store that changed after sealing
            say(f"{target}: up to date, nothing to do (stages.verify reads what it holds)")
            return None
        if state == "resume":
            build = places.begun_build()
            missing, sources = build.missing(), list[RowSource]()
            known = build.specs[FEATURES].shape[0] - len(missing)
        else:
            build = _new_build(surveyed, checked, places, say)
            missing = np.arange(build.specs[FEATURES].shape[0])
            begun = [] if places.begun is None else [places.part]
            sources = row_sources([*begun, *places.known], surveyed)
            known = count_known(checked, surveyed, sources)
        with closing(build):
            for line in plan_lines(build, surveyed, digests, places, state, known):
                say(line)
            if only_plan:
                return None
            if state == "new":
                check_space(build, checked, sources)
                if surveyed.spec.unfitted:
                    surveyed = _fitted(surveyed, checked, say)
                    build.plan = surveyed.plan
                # From here on, no check refuses the run.
                places = places.set_build_aside(surveyed, say)
                lay_out(build, checked, surveyed, row_sources(places.known, surveyed))
            sources = row_sources(places.known, surveyed)
            report = fill(build, surveyed, sources, digests, missing, _executor(surveyed))
            keep_golden(build, surveyed, places.stores, say)
            places.put_in_place(build, surveyed, say)
        return report


@contextmanager
def _opened(target: Path, only_plan: bool) -> Generator[ContentDigests]:
    """The digests kept beside the store, and the store's lock while the context is open."""
    with ExitStack() as stack:
        if only_plan:
            refuse_foreign_store(target)
            digests = ContentDigests.to_read(ledger_path(target))
        else:
            stack.enter_context(build_lock(target))
            recover(target)
            digests = ContentDigests(ledger_path(target))
        yield stack.enter_context(closing(digests))


def _survey(
    params: Params, digests: ContentDigests, places: StorePlaces, repair: bool, say: Say
) -> tuple[Survey, list[CheckedEpisode], BuildState]:
    """The survey, for a new build its sound episodes, each read completely, and the state."""
    surveyed = survey(params, digests)
    state, checked = places.state(surveyed.plan, repair), list[CheckedEpisode]()
    if state != "current":
        resolve_device(params.extract.device)
    if state == "new" or (surveyed.bad and params.data.on_bad_episode == "stop"):
        surveyed, checked = sound_episodes(surveyed, digests)  # lists everything that is wrong
        if repair and surveyed.spec.unfitted:  # the store's basis is damaged, too
            surveyed = _fitted(surveyed, checked, say)
            if places.finished != surveyed.plan:
                raise StoreMismatch(
                    f"{places.target}: its basis is damaged and cannot be fitted again to the bit. "
                    f"Run {extract_command(places.target)}: it fits another and computes every row"
                )
        state = places.state(surveyed.plan, repair)
    if repair and places.finished != surveyed.plan:
        raise StoreMismatch(
            f"{places.target}: expected the params that it was extracted with, found those of "
            "another store. Give them with --params, or move it away and extract (or merge) anew."
        )
    return surveyed, checked, state


def _new_build(
    surveyed: Survey, checked: Sequence[CheckedEpisode], places: StorePlaces, say: Say
) -> StoreBuild:
    """A build of these episodes, of which nothing is written yet; raises where it is refused."""
    places.refuse_to_lose(surveyed, embodiment_of(checked))
    for line in _timeline_lines(surveyed, checked):
        say(line)
    return StoreBuild(places.target, build_arrays(checked, surveyed), surveyed.plan)


def _fitted(surveyed: Survey, checked: Sequence[CheckedEpisode], say: Say) -> Survey:
    """The survey with a basis for its projected features, fitted on some of their rows."""
    from pipeline.extract.basis import fit_basis  # the model: seconds to import

    basis, line = fit_basis(surveyed, checked)
    say(line)
    return surveyed.on(basis)


def _executor(surveyed: Survey) -> Executor:
    """The executor: this process, or the dask workers of `extract.workers`."""
    if surveyed.extract.workers == 0:
        return compute_here
    from pipeline.extract.dask_cluster import compute_on_cluster  # dask: a second to import

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
