"""What became of the error with each stream spoilt -> what is printed, written and plotted."""

from collections.abc import Iterable, Sequence
from typing import Any

from pipeline.evaluate.ablation import ModalityStudy
from pipeline.evaluate.cells import aligned, cell, ratio
from pipeline.evaluate.names import with_unit
from pipeline.train.predictions import BASELINES
from pipeline.train.scores import Comparison

FOOTNOTE = "zeroed: every value at its training mean, which the policy sees as zeros"


def modality_errors(study: ModalityStudy) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Columns and rows of a table: each way to spoil a stream, between intact and best baseline.

    Two words, the errors of each group and the overall one, and the latter's multiple of intact.
    """
    groups = study.intact.varying_groups()
    names = [with_unit(group.name, group.unit) for group in groups]
    columns = ["stream", "policy sees it", *names, "overall [training std]", "times intact"]

    def errors(comparison: Comparison, method: str = "policy") -> tuple[float, ...]:
        of_groups = (comparison.group_mae(method, group) for group in groups)
        return *of_groups, comparison.overall(method)

    best = best_baseline(study.intact)
    intact, blind = study.intact.overall("policy"), study.intact.overall(best)
    rows = [("all", "intact", *errors(study.intact), 1.0)]
    rows += [
        (one.stream, one.how, *errors(one.comparison), study.times_intact(one))
        for one in study.spoilt
    ]
    times = blind / intact if intact > 0 else None
    rows.append(("none", best.replace("_", " "), *errors(study.intact, best), times))
    return columns, rows


def modality_table(study: ModalityStudy) -> str:
    """`modality_errors` as lines; below them what `zeroed` means, and what could not be judged."""
    columns, rows = modality_errors(study)
    lines = [columns]
    lines += [
        [stream, how, *(f"{error:.4g}" for error in errors), ratio(times)]
        for stream, how, *errors, times in rows
    ]
    return "\n".join([f"{judged_on(study)}:", *aligned(lines, left=2), FOOTNOTE, *study.notes])


def judged_on(study: ModalityStudy) -> str:
    """What a table of this study says above it."""
    return (
        f"mean absolute error on {study.intact.ticks} held-out ticks, {study.samples} chunk(s) a "
        "tick, one stream spoilt each"
    )


def modality_rows(study: ModalityStudy | None) -> Iterable[Sequence[object]]:
    """Lines of a CSV file: error by stream, way to spoil it, and action group.

    The headings alone where there is no study.
    """
    yield ["stream", "how", "group", "unit", "error", "intact_error", "best_baseline_error"]
    if study is None:
        return
    best = best_baseline(study.intact)
    for one in study.spoilt:
        for group in study.intact.groups:
            errors = (
                one.comparison.group_mae("policy", group),
                study.intact.group_mae("policy", group),
                study.intact.group_mae(best, group),
            )
            yield [one.stream, one.how, group.name, group.unit, *map(cell, errors)]
        overall = (
            one.comparison.overall("policy"),
            study.intact.overall("policy"),
            study.intact.overall(best),
        )
        yield [one.stream, one.how, "overall", "training std", *map(cell, overall)]


def stream_rows(study: ModalityStudy | None) -> Iterable[Sequence[object]]:
    """Lines of a CSV file: the overall error by way to spoil a stream, and what of the intact.

    The headings alone where there is no study.
    """
    yield ["spoilt", "times_intact", "overall_error"]
    if study is None:
        return
    for one in study.spoilt:
        times = study.times_intact(one)
        error = one.comparison.overall("policy")
        yield [f"{one.stream} {one.how}", "" if times is None else cell(times), cell(error)]


def best_baseline(comparison: Comparison) -> str:
    """The baseline with the lowest overall error."""
    return min(BASELINES, key=comparison.overall)
