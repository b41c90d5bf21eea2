"""What became of the error with each stream spoilt -> what is printed, written and plotted."""

from collections.abc import Iterable, Sequence
from typing import Any

from pipeline.evaluation.cells import aligned, cell, numbers, ratio
from pipeline.evaluation.modalities import ModalityStudy
from pipeline.evaluation.names import with_unit
from pipeline.evaluation.predictions import BASELINES
from pipeline.evaluation.scores import Comparison, Group

FOOTNOTE = "zeroed: every value at its training mean, which the policy sees as zeros"


def modality_metrics(study: ModalityStudy) -> dict[str, Any]:
    """The overall errors, in units of the training standard deviation, nested by stream."""
    document: dict[str, Any] = {
        "ticks": study.intact.ticks,
        "samples": study.samples,
        "intact": numbers({"overall": study.intact.overall("policy")}),
    }
    for one in study.spoilt:
        document.setdefault(one.stream, {})[one.how.replace(" ", "_")] = numbers(
            {
                "overall": one.comparison.overall("policy"),
                "times_intact": study.times_intact(one),
            }
        )
    return document


def modality_table(study: ModalityStudy) -> str:
    """A line for each way to spoil a stream, between the intact error and the best baseline's.

    Below them what `zeroed` means, and what could not be judged as asked.
    """
    groups = _told(study.intact)
    names = [with_unit(group.name, group.unit) for group in groups]
    lines = [["stream", "policy sees it", *names, "overall [training std]", "times intact"]]
    lines.append(["all", "intact", *_errors(study.intact, groups), "1.00"])
    lines += [
        [
            one.stream,
            one.how,
            *_errors(one.comparison, groups),
            ratio(study.times_intact(one)),
        ]
        for one in study.spoilt
    ]
    best = best_baseline(study.intact)
    intact, blind = study.intact.overall("policy"), study.intact.overall(best)
    lines.append(
        [
            "none",
            best.replace("_", " "),
            *_errors(study.intact, groups, best),
            ratio(blind / intact if intact > 0 else None),
        ]
    )
    head = (
        f"mean absolute error on {study.intact.ticks} held-out ticks, {study.samples} chunk(s) a "
        "tick, one stream spoilt each:"
    )
    return "\n".join([head, *aligned(lines, left=2), FOOTNOTE, *study.notes])


def modality_rows(study: ModalityStudy) -> Iterable[Sequence[object]]:
    """Lines of a CSV file: error by stream, way to spoil it, and action group."""
    yield ["stream", "how", "group", "unit", "error", "intact_error", "best_baseline_error"]
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


def best_baseline(comparison: Comparison) -> str:
    """The baseline with the lowest overall error."""
    return min(BASELINES, key=comparison.overall)


def _told(comparison: Comparison) -> list[Group]:
    """The groups with something to predict."""
    return [group for group in comparison.groups if comparison.relative(group) is not None]


def _errors(comparison: Comparison, groups: Sequence[Group], method: str = "policy") -> list[str]:
    errors = [comparison.group_mae(method, group) for group in groups]
    return [f"{error:.4g}" for error in (*errors, comparison.overall(method))]
