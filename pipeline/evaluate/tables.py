"""Scores -> what is printed, what DVC shows, what others plot."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pipeline.base.channels import named
from pipeline.base.durable import write_document
from pipeline.evaluate.ablation import ModalityStudy
from pipeline.evaluate.ablation_tables import best_baseline, modality_rows, stream_rows
from pipeline.evaluate.cells import aligned, cell, numbers, ratio, write_rows
from pipeline.evaluate.names import with_unit
from pipeline.store import FeatureStore
from pipeline.train.predictions import METHODS, Predictions
from pipeline.train.scores import Comparison

FOOTNOTE = (
    "repeat last: at an episode's first tick, which has none before it, it does nothing; where "
    "actions are absolute, it takes the mean training action"
)
METRICS = "metrics.json"
ERRORS = "errors.csv"
"""The file with the errors of all methods, a line an action group and one `OVERALL`."""
OVERALL = "overall"
HEADINGS = {
    "policy": "policy",
    "zero_action": "zero",
    "mean_action": "mean",
    "repeat_last": "repeat last",
}


def metrics(comparison: Comparison) -> dict[str, Any]:
    """The few numbers that tell two evaluations apart, for `metrics.json`; the rest is in tables.

    Mean absolute errors of the policy, `overall` in units of the training standard deviation
    (`Comparison.overall`), a group's in its own; `relative` is the error divided by the best
    baseline's. Numbers have 6 significant digits: less would hide, more would be noise.
    """
    document: dict[str, Any] = {
        "held_out": {"episodes": len(comparison.episodes), "ticks": comparison.ticks},
        "overall": numbers(
            {"policy": comparison.overall("policy"), "relative": comparison.relative()}
        ),
    }
    for group in comparison.groups:
        document[group.key] = numbers(
            {
                "policy": comparison.group_mae("policy", group),
                "relative": comparison.relative(group),
            }
        )
    return document


def error_rows(comparison: Comparison) -> list[tuple[str, list[float], float | None]]:
    """Mean absolute errors: what of, those of `METHODS`, and policy / best baseline.

    One for each action group, and the overall one last.
    """
    rows = [
        (
            with_unit(group.name, group.unit),
            [comparison.group_mae(method, group) for method in METHODS],
            comparison.relative(group),
        )
        for group in comparison.groups
    ]
    overall = [comparison.overall(method) for method in METHODS]
    return [*rows, ("overall [training std]", overall, comparison.relative())]


def still_dimensions(comparison: Comparison) -> str:
    """Which dimensions hardly move, and what the overall error is without; empty without any."""
    still = comparison.low_variance()
    if not still:
        return ""
    names = named(comparison.names, list(still))
    largest = max(still, key=lambda index: comparison.scale[index] / still[index])
    moving = comparison.without_low_variance()
    relative, best = moving.relative(), HEADINGS[best_baseline(moving)]
    beside = "" if relative is None else f", {ratio(relative)} times the best baseline's ({best})"
    return (
        f"hardly moving: {names} (training std at most {comparison.scale[largest]:.2g}, where "
        f"{still[largest]:.2g} is usual for such dimensions), {len(still)} of the "
        f"{len(comparison.varying())} dimensions in the overall error; without, it is "
        f"{moving.overall('policy'):.3f}{beside}"
    )


def table(comparison: Comparison) -> str:
    """Mean absolute errors of policy and baselines, a line a group and a footnote.

    Below them, where there are any, the dimensions that hardly move.
    """
    lines = [["mean absolute error", *(HEADINGS[method] for method in METHODS), "policy / best"]]
    lines += [
        [name, *(f"{error:.4g}" for error in errors), ratio(relative)]
        for name, errors, relative in error_rows(comparison)
    ]
    return "\n".join([*aligned(lines), FOOTNOTE, still_dimensions(comparison)]).rstrip("\n")


def write_tables(
    folder: Path,
    comparison: Comparison,
    predictions: Predictions,
    store: FeatureStore,
    study: ModalityStudy | None = None,
) -> list[Path]:
    """Write metrics.json and one CSV each of all errors, by dimension, horizon, episode and tick.

    And two by spoilt stream, which have headings alone without a `study`: `dvc plots` would miss
    the file, and one of an evaluation before would stay. steps.csv and streams.csv have one line a
    point, as `dvc plots` takes them; the rest is for others.
    """
    files = {
        ERRORS: _error_rows(comparison),
        "dimensions.csv": _dimension_rows(comparison),
        "horizon.csv": _horizon_rows(comparison),
        "steps.csv": _step_rows(comparison),
        "episodes.csv": _episode_rows(comparison, store),
        "predictions.csv": _prediction_rows(comparison, predictions, store),
        "modalities.csv": modality_rows(study),
        "streams.csv": stream_rows(study),
    }
    write_document(folder / METRICS, metrics(comparison))
    return [
        folder / METRICS,
        *(write_rows(folder / name, rows) for name, rows in files.items()),
    ]


def _error_rows(comparison: Comparison) -> Iterable[Sequence[object]]:
    yield ["group", "unit", *METHODS, "policy_rmse"]
    for group in comparison.groups:
        errors = (comparison.group_mae(method, group) for method in METHODS)
        rmse = comparison.group_rmse("policy", group)
        yield [group.name, group.unit, *map(cell, errors), cell(rmse)]
    yield [OVERALL, "training std", *(cell(comparison.overall(method)) for method in METHODS), ""]


def _dimension_rows(comparison: Comparison) -> Iterable[Sequence[object]]:
    yield ["dimension", "unit", *(f"{m}_mae" for m in METHODS), *(f"{m}_rmse" for m in METHODS)]
    for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True)):
        yield [
            name,
            unit,
            *(cell(comparison.scores[method].mae[index]) for method in METHODS),
            *(cell(comparison.scores[method].rmse[index]) for method in METHODS),
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
                *(cell(score.mae_horizon[step, index]) for score in scores),
                *(cell(score.rmse_horizon[step, index]) for score in scores),
            ]


def _step_rows(comparison: Comparison) -> Iterable[Sequence[object]]:
    """The overall error [training std] by steps ahead."""
    yield ["steps_ahead", *METHODS]
    scores = [comparison.scores[method].mae_horizon for method in METHODS]
    errors = [comparison.in_training_std(score).mean(axis=-1).tolist() for score in scores]
    for step, values in enumerate(zip(*errors, strict=True)):
        yield [step, *map(cell, values)]


def _episode_rows(comparison: Comparison, store: FeatureStore) -> Iterable[Sequence[object]]:
    yield ["source", "episode", "group", "unit", *METHODS]
    for place, index in enumerate(comparison.episodes):
        episode = store.episodes[index]
        for group in comparison.groups:
            errors = [float(group.mean(comparison.scores[m].mae_episode[place])) for m in METHODS]
            yield [episode.source, episode.id, group.name, group.unit, *map(cell, errors)]


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
            *(cell(value) for pair in pairs for value in pair),
        ]
