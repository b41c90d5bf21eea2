"""Experiments side by side -> what is printed, written and shown."""

from collections.abc import Iterable, Sequence
from typing import Any

from pipeline.evaluate.cells import aligned, cell, ratio
from pipeline.evaluate.experiments import Experiment
from pipeline.evaluate.names import with_unit
from pipeline.evaluate.tables import HEADINGS
from pipeline.train.predictions import BASELINES


def experiment_errors(
    experiments: Sequence[Experiment],
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Columns and rows of a table: an experiment a row, a baseline a row; mean absolute errors.

    `samples` are the chunks a tick whose mean was judged.
    """
    groups = experiments[0].errors
    names = (with_unit(*group) for group in groups)
    own = ("policy / best", "expert", "fusion", "samples", "parameters")
    rows: list[tuple[Any, ...]] = [
        (
            one.name,
            *(one.errors[group]["policy"] for group in groups),
            *(one.relative, one.model_type, one.fusion_strategy, one.samples, one.parameters),
        )
        for one in experiments
    ]
    for method in BASELINES:
        errors = (errors[method] for errors in groups.values())
        rows.append((f"baseline: {HEADINGS[method]}", *errors, None, "", "", None, None))
    return ["experiment", *names, *own], rows


def experiments_table(experiments: Sequence[Experiment], markdown: bool = False) -> str:
    """`experiment_errors` and the time that each training took, as lines."""
    columns, rows = experiment_errors(experiments)
    lines = [[*columns, "trained"]]
    for place, (name, *errors, relative, expert, fusion, samples, parameters) in enumerate(rows):
        cells = [name, *(f"{error:.4g}" for error in errors)]
        if place >= len(experiments):
            lines.append([*cells, "", "", "", "", "", ""])
            continue
        trained = experiments[place].training_s
        cells += [ratio(relative), expert, fusion, str(samples), f"{parameters:,}"]
        lines.append([*cells, "-" if trained is None else f"{trained:.0f} s"])
    if not markdown:
        return "\n".join(aligned(lines))
    ruler = ["---", *["---:"] * (len(lines[0]) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in [lines[0], ruler, *lines[1:]]) + "\n"


def experiment_rows(experiments: Sequence[Experiment]) -> Iterable[Sequence[object]]:
    """Lines of a CSV file, without the time of training: what the clock says is never tracked."""
    groups = list(experiments[0].errors)
    ways = [(group, method) for group in groups for method in ("policy", *BASELINES)]
    yield [
        *("experiment", "model_type", "fusion_strategy", "step", "parameters", "samples"),
        *(f"{Experiment.key(group)}_{method}" for group, method in ways),
    ]
    for one in experiments:
        yield [
            *(one.name, one.model_type, one.fusion_strategy),
            *(one.step, one.parameters, one.samples),
            *(cell(one.errors[group][method]) for group, method in ways),
        ]
