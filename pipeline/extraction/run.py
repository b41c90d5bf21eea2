"""Recordings x frozen model -> store, on one machine."""

import shutil
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from pipeline.config import Params
from pipeline.digests import ContentDigests
from pipeline.extraction.check import CheckedEpisode, check_episodes
from pipeline.extraction.fill import ExtractionReport, fill, rate_name
from pipeline.extraction.layout import build_arrays, lay_out
from pipeline.extraction.plan import ExtractionPlan, known_rows, reasons, store_bytes
from pipeline.extraction.survey import Survey, survey
from pipeline.store import Donor, StoreBuild, build_lock, free_bytes, part_path, read_plan, recover
from pipeline.store.schema import read_specs


def extract(params: Params, say: Callable[[str], None]) -> ExtractionReport | None:
    """Make `extract.store` hold exactly what `params` describe; None where it does already.

    Resumes an interrupted build of the same plan, takes known rows over from an older store of the
    same feature spec, and computes the rest. With `extract.plan` it only says what it would do.
    """
    target = params.extract.store
    with ExitStack() as stack:
        digests = stack.enter_context(closing(ContentDigests(_beside(target, ".files.sqlite"))))
        if not params.extract.plan:
            stack.enter_context(build_lock(target))
            recover(target)
        surveyed = survey(params, digests)
        for line in surveyed.missing:
            say(f"not there: {line}")
        if read_plan(target) == surveyed.plan:
            return None
        donors = stack.enter_context(_donors(target, surveyed, params.extract.plan))
        if read_plan(part_path(target)) == surveyed.plan:
            build = StoreBuild(target, read_specs(part_path(target)), surveyed.plan)
            stack.callback(build.close)
            _say_plan(_resume_plan(build, surveyed, params, digests), say)
        else:
            checked = check_episodes(surveyed, params)
            build = StoreBuild(target, build_arrays(checked, surveyed, params), surveyed.plan)
            stack.callback(build.close)
            _say_plan(_new_plan(build, checked, surveyed, donors, params, digests), say)
            if not params.extract.plan:
                lay_out(build, checked, surveyed, params, donors)
        if params.extract.plan:
            return None
        report = fill(build, surveyed, donors, params, digests)
        build.seal()
    for leftover in _set_aside(target):
        shutil.rmtree(leftover)
    return report


@contextmanager
def _donors(target: Path, surveyed: Survey, plan_only: bool) -> Generator[list[Donor]]:
    """Stores and abandoned builds of the same feature spec.

    An abandoned build of another plan is set aside; of another spec, it is of no use and removed.
    """
    part = part_path(target)
    abandoned = part.exists() and read_plan(part) != surveyed.plan
    if abandoned and not plan_only:
        plan = read_plan(part)
        if plan is not None and Donor(part).spec_digest == surveyed.spec.digest:
            part.rename(_beside(target, f".known-{plan[:8]}"))
        else:
            shutil.rmtree(part)
    places = [*_set_aside(target)]
    if abandoned and plan_only and read_plan(part) is not None:
        places.append(part)
    if target.exists():
        places.append(target)
    donors = [Donor(place) for place in places]
    try:
        yield [donor for donor in donors if donor.spec_digest == surveyed.spec.digest]
    finally:
        for donor in donors:
            donor.close()


def _set_aside(target: Path) -> list[Path]:
    return sorted(target.parent.glob(f"{target.name}.known-*"))


def _resume_plan(
    build: StoreBuild, surveyed: Survey, params: Params, digests: ContentDigests
) -> ExtractionPlan:
    rows = build.specs["vl/time"].shape[0]
    episodes = build.specs["episode/source"].shape[0]
    return ExtractionPlan(
        episodes=episodes,
        unchanged=episodes,
        rows=rows,
        known=rows - len(build.missing()),
        bytes=store_bytes(build.specs),
        free=free_bytes(build.part),
        rows_per_s=digests.rate(rate_name(surveyed, params)),
        reasons=(f"continuing the interrupted build {build.part}",),
    )


def _new_plan(
    build: StoreBuild,
    checked: Sequence[CheckedEpisode],
    surveyed: Survey,
    donors: Sequence[Donor],
    params: Params,
    digests: ContentDigests,
) -> ExtractionPlan:
    before = {digest for donor in donors for digest in donor.episode_digests}
    store = Donor(build.target) if build.target.exists() else None
    return ExtractionPlan(
        episodes=len(checked),
        unchanged=sum(one.surveyed.digest in before for one in checked),
        rows=build.specs["vl/time"].shape[0],
        known=known_rows(checked, surveyed.spec.views, donors),
        bytes=store_bytes(build.specs),
        free=free_bytes(build.part),
        rows_per_s=digests.rate(rate_name(surveyed, params)),
        reasons=reasons(surveyed, store, build.specs),
    )


def _say_plan(plan: ExtractionPlan, say: Callable[[str], None]) -> None:
    for line in plan.lines():
        say(line)


def _beside(target: Path, suffix: str) -> Path:
    return target.with_name(target.name + suffix)
