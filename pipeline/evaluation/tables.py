"""Scores -> what is printed, what DVC shows, what others plot."""

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pipeline.durable import disk_full_named, fresh, write_document
from pipeline.evaluation.names import with_unit
from pipeline.evaluation.predictions import METHODS, Predictions
from pipeline.evaluation.scores import Comparison
from pipeline.store import FeatureStore

FOOTNOTE = (
    "repeat last: at an episode's first tick, which has none before it, it does nothing; where "
    "actions are absolute, it takes the mean training action"
)
HEADINGS = {
    "policy": "policy",
    "zero_action": "zero",
    "mean_action": "mean",
    "repeat_last": "repeat last",
}


def metrics(comparison: Comparison) -> dict[str, Any]:
    """The essential numbers, nested, for `metrics.json`.

    `overall` is in units of the training standard deviation (`Comparison.overall`), a group in
    its own; `relative` is the policy's error divided by the best baseline's. `horizon` is by step
    of the chunk, of which step_1 is the action at the tick itself; a step that no held-out chunk
    reaches is left out. Numbers have 6 significant digits: less would hide, more would be noise.
    """
    document: dict[str, Any] = {
        "held_out": {"episodes": len(comparison.episodes), "ticks": comparison.ticks},
        "overall": _numbers(
            {method: comparison.overall(method) for method in METHODS}
            | {"relative": comparison.relative()}
        ),
    }
    for group in comparison.groups:
        document[group.key] = _numbers(
            {method: comparison.group_mae(method, group) for method in METHODS}
            | {
                "relative": comparison.relative(group),
                "policy_rmse": comparison.group_rmse("policy", group),
            }
        )
    document["dimension"] = {
        f"{name}_{unit}" if unit else name: _numbers(
            {method: float(comparison.scores[method].mae[index]) for method in METHODS}
        )
        for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True))
    }
    document["horizon"] = {
        group.key: {
            method: _steps(group.mean(comparison.scores[method].mae_horizon).tolist())
            for method in METHODS
        }
        for group in comparison.groups
    }
    return document


def table(comparison: Comparison) -> str:
    """Mean absolute errors of policy and baselines, a line a group and a footnote."""
    head = ["mean absolute error", *(HEADINGS[method] for method in METHODS), "policy / best"]
    lines = [head]
    for group in comparison.groups:
        errors = [comparison.group_mae(method, group) for method in METHODS]
        lines.append(_line(with_unit(group.name, group.unit), errors, comparison.relative(group)))
    errors = [comparison.overall(method) for method in METHODS]
    lines.append(_line("overall [training std]", errors, comparison.relative()))
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    rows = [
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    ]
    return "\n".join([*rows, FOOTNOTE])


def write_tables(
    folder: Path, comparison: Comparison, predictions: Predictions, store: FeatureStore
) -> list[Path]:
    """Write metrics.json and, for plots, one CSV each by dimension, horizon, episode and tick."""
    files = {
        "dimensions.csv": _dimension_rows(comparison),
        "horizon.csv": _horizon_rows(comparison),
        "episodes.csv": _episode_rows(comparison, store),
        "predictions.csv": _prediction_rows(comparison, predictions, store),
    }
    write_document(folder / "metrics.json", metrics(comparison))
    with disk_full_named(folder):
        for name, rows in files.items():
            with fresh(folder / name).open("w", encoding="utf-8", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows(rows)
    return [folder / "metrics.json", *(folder / name for name in files)]


def _dimension_rows(comparison: Comparison) -> Iterable[Sequence[object]]:
    yield ["dimension", "unit", *(f"{m}_mae" for m in METHODS), *(f"{m}_rmse" for m in METHODS)]
    for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True)):
        yield [
            name,
            unit,
            *(_cell(comparison.scores[method].mae[index]) for method in METHODS),
            *(_cell(comparison.scores[method].rmse[index]) for method in METHODS),
        ]


def _horizon_rows(comparison: Comparison) -> Iterable[Sequence[object]]:
    yield ["steps_ahead", "dimension", "unit", *METHODS, *(f"{m}_rmse" for m in METHODS)]
    for step in range(len(comparison.scores["policy"].mae_horizon)):
        for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True)):
            scores = [comparison.scores[method] for method in METHODS]
            yield [
                step,
                name,
                unit,
                *(_cell(score.mae_horizon[step, index]) for score in scores),
                *(_cell(score.rmse_horizon[step, index]) for score in scores),
            ]


def _episode_rows(comparison: Comparison, store: FeatureStore) -> Iterable[Sequence[object]]:
    yield ["source", "episode", "group", "unit", *METHODS]
    for place, index in enumerate(comparison.episodes):
        episode = store.episodes[index]
        for group in comparison.groups:
            errors = [float(group.mean(comparison.scores[m].mae_episode[place])) for m in METHODS]
            yield [episode.source, episode.id, group.name, group.unit, *map(_cell, errors)]


def _prediction_rows(
    comparison: Comparison, predictions: Predictions, store: FeatureStore
) -> Iterable[Sequence[object]]:
    columns = [f"{name}_{what}" for name in comparison.names for what in ("recorded", "predicted")]
    yield ["source", "episode", "time_s", *columns]
    time_s = store.array("tick/time")[predictions.ticks]
    for place, index in enumerate(predictions.episodes):
        episode = store.episodes[index]
        pairs = zip(predictions.recorded[place, 0], predictions.predicted[place, 0], strict=True)
        yield [
            episode.source,
            episode.id,
            f"{time_s[place]:.3f}",
            *(_cell(value) for pair in pairs for value in pair),
        ]


def _line(name: str, errors: Sequence[float], relative: float | None) -> list[str]:
    ratio = "-" if relative is None else f"{relative:.2f}"
    return [name, *(f"{error:.4g}" for error in errors), ratio]


def _numbers(values: dict[str, float | None] | dict[str, float]) -> dict[str, float]:
    """Without what has no value; a NaN stays, and a JSON document refuses it."""
    return {key: float(f"{value:.6g}") for key, value in values.items() if value is not None}


def _steps(errors: Sequence[float]) -> dict[str, float]:
    """Scores are NaN where no entry is valid."""
    steps = {f"step_{step}": error for step, error in enumerate(errors, start=1)}
    return _numbers({name: error for name, error in steps.items() if not math.isnan(error)})


def _cell(value: float) -> str:
    return "" if math.isnan(value) else f"{float(value):.6g}"
