"""Evaluations of several experiments -> one table."""

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

from pipeline.checkpoint import describe, differences
from pipeline.config import FusionStrategy, ModelType
from pipeline.errors import ConfigError
from pipeline.evaluation.cells import aligned, cell, ratio
from pipeline.evaluation.judged import JUDGED
from pipeline.evaluation.predictions import BASELINES, METHODS
from pipeline.evaluation.scores import Group
from pipeline.evaluation.tables import ERRORS, HEADINGS, OVERALL

_SAME = 1e-4
"""Relative difference of two baselines that rounding on another machine explains."""


@dataclass(frozen=True)
class _Shared:
    """What evaluations in one table share, and what to do where they do not."""

    expected: str
    remedy: str


_SAME_TICKS = _Shared(
    "evaluations on the same held-out ticks", "Evaluate all of them on the same recordings"
)
_SAMPLED_ALIKE = _Shared(
    "evaluations of stochastic policies from as many samples and ticks a batch",
    "Evaluate all of them with one evaluate.samples and evaluate.batch_size",
)


@dataclass(frozen=True)
class Experiment:
    """One evaluation, read back."""

    name: str
    model_type: str
    fusion_strategy: str
    step: int
    parameters: int
    samples: int
    errors: Mapping[str, Mapping[str, float]]
    """`overall` [training std] and each action group -> error of the policy and each baseline."""
    training_s: float | None
    """Time that its training took; None where its speed file is not there."""

    @property
    def error(self) -> float:
        """The policy's overall error."""
        return self.errors[OVERALL]["policy"]

    @property
    def relative(self) -> float | None:
        """It, divided by that of the best baseline."""
        best = min(self.errors[OVERALL][method] for method in BASELINES)
        return self.error / best if best > 0 else None


def read_experiments(reports: Path) -> tuple[Experiment, ...]:
    """The evaluations in the folders of `reports`, ordered by expert, fusion and name.

    Raises `ConfigError` where there is none, where a folder is no evaluation, where they were not
    judged on the same ticks, and where stochastic policies were not sampled alike.
    """
    folders = sorted(path for path in reports.glob("*") if path.is_dir())
    if not folders:
        raise ConfigError(
            f"compare.reports: expected one folder for each experiment in {reports}, found none. "
            "Run stages.evaluate for each with its own evaluate.output there, or "
            "dvc repro experiments/dvc.yaml."
        )
    judged = [_read(folder, JUDGED, "policy", "drawn", "on") for folder in folders]
    named = [(folder.name, what) for folder, what in zip(folders, judged, strict=True)]
    _check_same(reports, "on", named, _SAME_TICKS)
    sampled = [(name, what) for name, what in named if what["drawn"] is not None]
    _check_same(reports, "drawn", sampled, _SAMPLED_ALIKE)
    found = [
        _experiment(folder, what["policy"]) for folder, what in zip(folders, judged, strict=True)
    ]
    for one, other in pairwise(found):
        _check_baselines(reports, one, other)
    return tuple(sorted(found, key=_order))


def experiment_errors(
    experiments: Sequence[Experiment],
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Columns and rows of a table: an experiment a row, a baseline a row; mean absolute errors.

    `samples` are the chunks a tick whose mean was judged.
    """
    units = list(experiments[0].errors)
    names = ["overall [training std]" if unit == OVERALL else unit for unit in units]
    columns = ["experiment", "expert", "fusion", *names, "policy / best", "samples", "parameters"]
    rows: list[tuple[Any, ...]] = [
        (
            *(one.name, one.model_type, one.fusion_strategy),
            *(one.errors[unit]["policy"] for unit in units),
            *(one.relative, one.samples, one.parameters),
        )
        for one in experiments
    ]
    for method in BASELINES:
        errors = (experiments[0].errors[unit][method] for unit in units)
        rows.append((f"baseline: {HEADINGS[method]}", "", "", *errors, None, None, None))
    return columns, rows


def experiments_table(experiments: Sequence[Experiment], markdown: bool = False) -> str:
    """`experiment_errors` and the time that each training took, as lines."""
    columns, rows = experiment_errors(experiments)
    lines = [[*columns, "trained"]]
    for place, (name, expert, fusion, *errors, relative, samples, parameters) in enumerate(rows):
        cells = [name, expert, fusion, *(f"{error:.4g}" for error in errors)]
        if place >= len(experiments):
            lines.append([*cells, "", "", "", ""])
            continue
        trained = experiments[place].training_s
        cells += [ratio(relative), str(samples), f"{parameters:,}"]
        lines.append([*cells, "-" if trained is None else f"{trained:.0f} s"])
    if not markdown:
        return "\n".join(aligned(lines, left=3))
    ruler = ["---"] * 3 + ["---:"] * (len(lines[0]) - 3)
    return "\n".join(f"| {' | '.join(line)} |" for line in [lines[0], ruler, *lines[1:]]) + "\n"


def experiment_rows(experiments: Sequence[Experiment]) -> Iterable[Sequence[object]]:
    """Lines of a CSV file, without the time of training: what the clock says is never tracked."""
    units = list(experiments[0].errors)
    yield [
        *("experiment", "model_type", "fusion_strategy", "step", "parameters", "samples"),
        *(f"{unit}_{method}" for unit in units for method in ("policy", *BASELINES)),
    ]
    for one in experiments:
        yield [
            *(one.name, one.model_type, one.fusion_strategy),
            *(one.step, one.parameters, one.samples),
            *(cell(one.errors[unit][m]) for unit in units for m in ("policy", *BASELINES)),
        ]


def speed_file(logs: Path) -> Path:
    """Where a training writes its speed: beside its logs, for DVC tracks all that is in them."""
    return logs.with_name(f"{logs.name}.speed.tsv")


def training_seconds(logs: Path) -> float | None:
    """What the speed file beside these logs says that the training took; None without it."""
    path = speed_file(logs)
    if not path.exists():
        return None
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines(), delimiter="\t"))
    return float(rows[-1]["trained_s"]) if rows and rows[-1].get("trained_s") else None


def _experiment(folder: Path, policy: Mapping[str, Any]) -> Experiment:
    try:
        return Experiment(
            name=folder.name,
            errors=_errors(folder),
            training_s=training_seconds(Path(policy["logs"])),
            **{key: value for key, value in policy.items() if key != "logs"},
        )
    except (KeyError, TypeError) as error:
        raise ConfigError(_no_evaluation(folder, f"it lacks {error}")) from None


def _errors(folder: Path) -> dict[str, dict[str, float]]:
    """Of `OVERALL`, which comes first, and each action group, by method."""
    rows = list(csv.DictReader(_text(folder, ERRORS).splitlines()))
    try:
        errors = {
            row["group"] if row["group"] == OVERALL else Group(row["group"], row["unit"], ()).key: {
                method: float(row[method]) for method in METHODS
            }
            for row in rows
        }
    except ValueError as error:
        raise ConfigError(_no_evaluation(folder, f"{ERRORS} cannot be read: {error}")) from None
    return {OVERALL: errors.pop(OVERALL), **errors}


def _check_same(
    reports: Path, key: str, judged: Sequence[tuple[str, Mapping[str, Any]]], same: _Shared
) -> None:
    for (one, what), (other, what_other) in pairwise(judged):
        differing = differences(what[key], what_other[key])
        if differing:
            raise ConfigError(
                f"compare.reports: expected {same.expected} in {reports}, but they differ:\n"
                f"{describe(differing, one, other)}\n"
                f"{same.remedy}, or move those that do not belong away."
            )


def _check_baselines(reports: Path, one: Experiment, other: Experiment) -> None:
    for unit, errors in one.errors.items():
        for method in BASELINES:
            found = other.errors.get(unit, {}).get(method, math.nan)
            if not math.isclose(errors[method], found, rel_tol=_SAME, abs_tol=1e-9):
                raise ConfigError(
                    f"compare.reports: expected the same baselines in all evaluations in "
                    f"{reports}, found {method} ({unit}) {errors[method]} in {one.name} and "
                    f"{found} in {other.name}: they were trained on other recordings. Train and "
                    "evaluate all of them on one store, or move those that do not belong away."
                )


def _read(folder: Path, name: str, *keys: str) -> dict[str, Any]:
    try:
        document = json.loads(_text(folder, name))
    except ValueError as error:
        raise ConfigError(_no_evaluation(folder, f"{name} is no JSON: {error}")) from None
    lacking = [key for key in keys if key not in document]
    if lacking:
        raise ConfigError(_no_evaluation(folder, f"it lacks {lacking[0]!r} in {name}"))
    return document


def _text(folder: Path, name: str) -> str:
    try:
        return (folder / name).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(_no_evaluation(folder, f"it has no {name}")) from None


def _no_evaluation(folder: Path, why: str) -> str:
    return (
        f"compare.reports: expected the output of stages.evaluate in {folder}, but {why}. Evaluate "
        "that experiment again with this version, or move the folder away."
    )


def _order(experiment: Experiment) -> tuple[int, int, str]:
    places = [
        names.index(name) if name in names else len(names)
        for names, name in (
            (get_args(ModelType), experiment.model_type),
            (get_args(FusionStrategy), experiment.fusion_strategy),
        )
    ]
    return places[0], places[1], experiment.name
