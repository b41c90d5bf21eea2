"""Scores -> what is printed, what DVC shows, what others plot."""

from pathlib import Path
from typing import Any

from pipeline.base.channels import named
from pipeline.base.durable import write_document
from pipeline.base.table import Table
from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.names import rounded, with_unit
from pipeline.store import FeatureStore
from pipeline.train.predictions import BASELINES, METHODS, Predictions
from pipeline.train.scores import Comparison

FOOTNOTE = (
    "repeat last: at an episode's first tick, which has none before it, it does nothing; where "
    "actions are absolute, it takes the mean training action"
)
ABLATION_FOOTNOTE = "zeroed: every value at its training mean, which the policy sees as zeros"
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
        [
            with_unit(group.name, group.unit),
            *(comparison.group_mae(method, group) for method in METHODS),
            comparison.relative(group),
        ]
        for group in comparison.groups
    ]
    overall = (comparison.overall(method) for method in METHODS)
    rows.append(["overall [training std]", *overall, comparison.relative()])
    heads = (HEADINGS[method] for method in METHODS)
    return Table(["mean absolute error", *heads, "policy / best"], rows)


def still_dimensions(comparison: Comparison) -> str:
    """Which dimensions hardly move, and what the overall error is without; empty without any."""
    still = comparison.still()
    if not still:
        return ""
    names = named(comparison.names, list(still))
    largest = max(still, key=lambda index: comparison.scale[index] / still[index])
    moving = comparison.without_still()
    relative, best = moving.relative(), HEADINGS[best_baseline(moving)]
    beside = "" if relative is None else f", {relative:.2f} times the best baseline's ({best})"
    return (
        f"hardly moving: {names} (training std at most {comparison.scale[largest]:.2g}, where "
        f"{still[largest]:.2g} is usual for such dimensions), {len(still)} of the "
        f"{len(comparison.varying())} dimensions in the overall error; without, it is "
        f"{moving.overall('policy'):.3f}{beside}"
    )


def error_text(comparison: Comparison) -> str:
    """`error_table` and its footnote as lines; below them the dimensions that hardly move."""
    lines = [*error_table(comparison).text(), FOOTNOTE, still_dimensions(comparison)]
    return "\n".join(lines).rstrip("\n")


def ablation_table(study: AblationStudy) -> Table:
    """Each way to ablate a stream, between intact and best baseline.

    Two words, the errors of each group and the overall one, and the latter's multiple of intact.
    """
    groups = study.intact.varying_groups()

    def row(stream: str, how: str, comparison: Comparison, method: str = "policy") -> list[Any]:
        overall, intact = comparison.overall(method), study.intact.overall("policy")
        errors = (comparison.group_mae(method, group) for group in groups)
        return [stream, how, *errors, overall, overall / intact if intact > 0 else None]

    best = best_baseline(study.intact)
    rows = [row("all", "intact", study.intact)]
    rows += [row(ablated.stream, ablated.how, ablated.comparison) for ablated in study.ablated]
    rows.append(row("none", best.replace("_", " "), study.intact, best))
    names = (with_unit(group.name, group.unit) for group in groups)
    heads = ["stream", "policy sees it", *names, "overall [training std]", "times intact"]
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
        ERRORS: _errors(comparison),
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


def _errors(comparison: Comparison) -> Table:
    rows: list[list[Any]] = [
        [
            *(group.name, group.unit),
            *(comparison.group_mae(method, group) for method in METHODS),
            comparison.group_rmse("policy", group),
        ]
        for group in comparison.groups
    ]
    overall = (comparison.overall(method) for method in METHODS)
    rows.append([OVERALL, "training std", *overall, None])
    return Table(["group", "unit", *METHODS, "policy_rmse"], rows)


def _dimensions(comparison: Comparison) -> Table:
    scores = [comparison.scores[method] for method in METHODS]
    rows = [
        [
            *(name, unit),
            *(score.mae[index] for score in scores),
            *(score.rmse[index] for score in scores),
        ]
        for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True))
    ]
    errors = (f"{method}_{error}" for error in ("mae", "rmse") for method in METHODS)
    return Table(["dimension", "unit", *errors], rows)


def _horizon(comparison: Comparison) -> Table:
    scores = [comparison.scores[method] for method in METHODS]
    rows = [
        [
            *(step, name, unit),
            *(score.mae_horizon[step, index] for score in scores),
            *(score.rmse_horizon[step, index] for score in scores),
        ]
        for step in range(len(scores[0].mae_horizon))
        for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True))
    ]
    rmse = (f"{method}_rmse" for method in METHODS)
    return Table(["steps_ahead", "dimension", "unit", *METHODS, *rmse], rows)


def _steps(comparison: Comparison) -> Table:
    """The overall error [training std] by steps ahead."""
    scores = [comparison.scores[method].mae_horizon for method in METHODS]
    errors = [comparison.in_training_std(score).mean(axis=-1).tolist() for score in scores]
    rows = [[step, *values] for step, values in enumerate(zip(*errors, strict=True))]
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
    rows: list[list[Any]] = []
    time_s = store.array("tick/time")[predictions.ticks]
    for place, index in enumerate(predictions.episodes):
        episode = store.episodes[index]
        pairs = zip(predictions.recorded[place, 0], predictions.predicted[place, 0], strict=True)
        values = (value for pair in pairs for value in pair)
        rows.append([episode.source, episode.id, f"{time_s[place]:.3f}", *values])
    columns = (f"{name}_{what}" for name in comparison.names for what in ("recorded", "predicted"))
    return Table(["source", "episode", "time_s", *columns], rows)


def _ablation_errors(study: AblationStudy | None) -> Table:
    """Error by stream, way to ablate it, and action group."""
    rows: list[list[Any]] = []
    if study is not None:
        best = best_baseline(study.intact)
        for ablated in study.ablated:
            named = (ablated.stream, ablated.how)
            compared = [(ablated.comparison, "policy"), (study.intact, "policy")]
            compared.append((study.intact, best))
            for group in study.intact.groups:
                errors = (comparison.group_mae(method, group) for comparison, method in compared)
                rows.append([*named, group.name, group.unit, *errors])
            overall = (comparison.overall(method) for comparison, method in compared)
            rows.append([*named, OVERALL, "training std", *overall])
    errors = ("error", "intact_error", "best_baseline_error")
    return Table(["stream", "how", "group", "unit", *errors], rows)


def _streams(study: AblationStudy | None) -> Table:
    """The overall error by way to ablate a stream, and what of the intact."""
    rows: list[list[Any]] = []
    if study is not None:
        for ablated in study.ablated:
            errors = (study.times_intact(ablated), ablated.comparison.overall("policy"))
            rows.append([f"{ablated.stream} {ablated.how}", *errors])
    return Table(["spoilt", "times_intact", "overall_error"], rows)
