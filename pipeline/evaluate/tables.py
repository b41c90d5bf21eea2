"""Scores -> what is printed, what DVC shows, what others plot."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.channels import named
from pipeline.base.durable import write_document
from pipeline.base.table import Table
from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.names import rounded, with_unit
from pipeline.store import FeatureStore
from pipeline.train.predictions import BASELINES, METHODS, Predictions
from pipeline.train.scores import ActionGroup, Comparison

FOOTNOTE = (
    "repeat last: at an episode's first tick, which has none before it, it does nothing; where "
    "actions are absolute, it takes the mean training action"
)
ABLATION_FOOTNOTE = "zeroed: every value at its training mean, which the policy sees as zeros"
METRICS = "metrics.json"
ERRORS = "errors.csv"
"""The file with the errors of all methods, a line an action group and one `OVERALL`."""
OVERALL = "overall"
_STD = "training std"
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
        "overall": rounded(
            {"policy": comparison.overall("policy"), "relative": comparison.relative()}
        ),
    }
    for group in comparison.groups:
        policy, relative = comparison.group_mae("policy", group), comparison.relative(group)
        document[group.key] = rounded({"policy": policy, "relative": relative})
    return document


def best_baseline(comparison: Comparison) -> str:
    """The baseline with the lowest overall error."""
    return min(BASELINES, key=comparison.overall)


def error_table(comparison: Comparison) -> Table:
    """Mean absolute errors of policy and baselines, a row an action group, the overall one last."""
    rows = [
        [_heading(group), *_errors(comparison, group), comparison.relative(group)]
        for group in (*comparison.groups, None)
    ]
    heads = (HEADINGS[method] for method in METHODS)
    return Table(["mean absolute error", *heads, "policy / best"], rows)


def _heading(group: ActionGroup | None) -> str:
    """The name of a group with its unit, or of the overall error."""
    return with_unit(OVERALL, _STD) if group is None else with_unit(group.name, group.unit)


def _errors(comparison: Comparison, group: ActionGroup | None) -> list[float]:
    """Of each method, in the group's unit; of None, overall."""
    if group is None:
        return [comparison.overall(method) for method in METHODS]
    return [comparison.group_mae(method, group) for method in METHODS]


def still_dimensions(comparison: Comparison) -> str:
    """Which dimensions hardly move, and what the overall error is without; empty without any."""
    still = comparison.low_variance()
    if not still:
        return ""
    largest = max(still, key=lambda index: comparison.scale[index] / still[index])
    moving = comparison.without_low_variance()
    relative = moving.relative() or np.nan
    return (
        f"hardly moving: {named(comparison.names, list(still))} (training std at most "
        f"{comparison.scale[largest]:.2g}, where {still[largest]:.2g} is usual for such "
        f"dimensions), {len(still)} of the {len(comparison.varying())} dimensions in the overall "
        f"error; without, it is {moving.overall('policy'):.3f}, {relative:.2f} times the best "
        f"baseline's ({HEADINGS[best_baseline(moving)]})"
    )


def error_text(comparison: Comparison) -> str:
    """`error_table` and its footnote as lines; below them the dimensions that hardly move."""
    lines = [*error_table(comparison).text(), FOOTNOTE, still_dimensions(comparison)]
    return "\n".join(lines).rstrip("\n")


def ablation_table(study: AblationStudy) -> Table:
    """Each way to ablate a stream, between intact and best baseline.

    Two words, the errors of each group and the overall one, and the latter's multiple of intact.
    """
    best, intact = best_baseline(study.intact), study.intact.overall("policy")
    groups = study.intact.varying_groups()
    ways = [("all", "intact", study.intact, "policy")]
    ways += [(way.stream, way.how, way.comparison, "policy") for way in study.ablated]
    ways.append(("none", best.replace("_", " "), study.intact, best))
    rows: list[list[Any]] = []
    for stream, how, comparison, method in ways:
        errors = (comparison.group_mae(method, group) for group in groups)
        overall = comparison.overall(method)
        rows.append([stream, how, *errors, overall, overall / intact if intact > 0 else None])
    names = map(_heading, (*groups, None))
    heads = ["stream", "policy sees it", *names, "times intact"]
    return Table(heads, rows, caption=ABLATION_FOOTNOTE, strong=frozenset({0}))


def ablation_text(study: AblationStudy) -> str:
    """`ablation_table` as lines; below them what `zeroed` means, and what was not evaluated."""
    lines = [f"{evaluated_on(study)}:", *ablation_table(study).text()]
    return "\n".join([*lines, ABLATION_FOOTNOTE, *study.notes])


def evaluated_on(study: AblationStudy) -> str:
    """What a table of this study says above it."""
    return (
        f"mean absolute error on {study.intact.ticks} held-out ticks, {study.samples} chunk(s) a "
        "tick, one stream ablated each"
    )


def write_tables(
    folder: Path,
    comparison: Comparison,
    predictions: Predictions,
    store: FeatureStore,
    study: AblationStudy | None = None,
) -> list[Path]:
    """Write metrics.json and one CSV each of all errors, by dimension, horizon, episode and tick.

    And two by ablated stream, which have headings alone without a `study`: `dvc plots` would miss
    the file, and one of an evaluation before would stay. steps.csv and streams.csv have one line a
    point, as `dvc plots` takes them; the rest is for others.
    """
    files = {
        ERRORS: _group_errors(comparison),
        "dimensions.csv": _dimensions(comparison),
        "horizon.csv": _horizon(comparison),
        "steps.csv": _steps(comparison),
        "episodes.csv": _episodes(comparison, store),
        "predictions.csv": _predictions(comparison, predictions, store),
        "modalities.csv": _ablation_errors(study),
        "streams.csv": _streams(study),
    }
    write_document(folder / METRICS, metrics(comparison))
    return [folder / METRICS, *(files[name].write_csv(folder / name) for name in files)]


def _group_errors(comparison: Comparison) -> Table:
    rows: list[list[Any]] = [
        [
            group.name,
            group.unit,
            *_errors(comparison, group),
            comparison.group_rmse("policy", group),
        ]
        for group in comparison.groups
    ]
    rows.append([OVERALL, _STD, *_errors(comparison, None), None])
    return Table(["group", "unit", *METHODS, "policy_rmse"], rows)


def _dimensions(comparison: Comparison) -> Table:
    scores = [comparison.scores[method] for method in METHODS]
    errors = np.array([*(score.mae for score in scores), *(score.rmse for score in scores)])
    rows = [
        [*dimension, *values]
        for *dimension, values in zip(
            comparison.names, comparison.units, errors.T.tolist(), strict=True
        )
    ]
    heads = (f"{method}_{error}" for error in ("mae", "rmse") for method in METHODS)
    return Table(["dimension", "unit", *heads], rows)


def _horizon(comparison: Comparison) -> Table:
    scores = [comparison.scores[method] for method in METHODS]
    errors = [*(score.mae_horizon for score in scores), *(score.rmse_horizon for score in scores)]
    rows = [
        [step, *dimension, *values]
        for step, of_step in enumerate(np.stack(errors, axis=-1).tolist())
        for *dimension, values in zip(comparison.names, comparison.units, of_step, strict=True)
    ]
    rmse = (f"{method}_rmse" for method in METHODS)
    return Table(["steps_ahead", "dimension", "unit", *METHODS, *rmse], rows)


def _steps(comparison: Comparison) -> Table:
    """The overall error [training std] by steps ahead."""
    scores = [comparison.scores[method].mae_horizon for method in METHODS]
    errors = np.array([comparison.in_training_std(score).mean(axis=-1) for score in scores])
    rows = [[step, *values] for step, values in enumerate(errors.T.tolist())]
    return Table(["steps_ahead", *METHODS], rows)


def _episodes(comparison: Comparison, store: FeatureStore) -> Table:
    rows = [
        [
            *(store.episodes[index].source, store.episodes[index].id, group.name, group.unit),
            *(group.mean(comparison.scores[method].mae_episode[place]) for method in METHODS),
        ]
        for place, index in enumerate(comparison.episodes)
        for group in comparison.groups
    ]
    return Table(["source", "episode", "group", "unit", *METHODS], rows)


def _predictions(comparison: Comparison, predictions: Predictions, store: FeatureStore) -> Table:
    time_s = store.array("tick/time")[predictions.ticks]
    first = np.stack([predictions.recorded[:, 0], predictions.predicted[:, 0]], axis=-1)
    episodes = (store.episodes[index] for index in predictions.episodes)
    rows = [
        [episode.source, episode.id, f"{time:.3f}", *values.flat]
        for episode, time, values in zip(episodes, time_s, first, strict=True)
    ]
    columns = (f"{name}_{what}" for name in comparison.names for what in ("recorded", "predicted"))
    return Table(["source", "episode", "time_s", *columns], rows)


def _ablation_errors(study: AblationStudy | None) -> Table:
    """Error by stream, way to ablate it, and action group."""
    rows: list[list[Any]] = []
    if study is not None:
        best = METHODS.index(best_baseline(study.intact))
        for way in study.ablated:
            for group in (*study.intact.groups, None):
                name = (OVERALL, _STD) if group is None else (group.name, group.unit)
                error, intact = _errors(way.comparison, group)[0], _errors(study.intact, group)
                rows.append([way.stream, way.how, *name, error, intact[0], intact[best]])
    errors = ("error", "intact_error", "best_baseline_error")
    return Table(["stream", "how", "group", "unit", *errors], rows)


def _streams(study: AblationStudy | None) -> Table:
    """The overall error by way to ablate a stream, and what of the intact."""
    rows = (
        []
        if study is None
        else [
            [f"{way.stream} {way.how}", study.times_intact(way), way.comparison.overall("policy")]
            for way in study.ablated
        ]
    )
    return Table(["spoilt", "times_intact", "overall_error"], rows)
