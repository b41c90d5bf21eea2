"""The page of an evaluation: how well a policy does, where it errs, and what it was made of."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.evaluation import Evaluation
from pipeline.evaluate.names import with_unit
from pipeline.evaluate.tables import (
    ABLATION_FOOTNOTE,
    FOOTNOTE,
    HEADINGS,
    ablation_table,
    best_baseline,
    error_table,
    evaluated_on,
    still_dimensions,
)
from pipeline.look.evaluation import pictures as plots
from pipeline.look.evaluation.episodes import episodes, extremes
from pipeline.look.page.blocks import Block, Document, Picture, Report, Section, Table, Text
from pipeline.look.page.cells import sentence
from pipeline.train.predictions import METHODS
from pipeline.train.scores import Comparison

_NAMES = 8
"""Channels of a stream named in the params; an A-scan has a thousand."""


def evaluation_report(found: Evaluation) -> Report:
    """The page of a judgement, its recordings' frames read where they still lie.

    Says nothing of the clock and nothing of where it is written: the same judgement gives the same
    page.
    """
    comparison, policy = found.comparison, found.judged["policy"]
    return Report(
        title=f"Evaluation of {found.name}",
        summary=(
            f"{policy['model_type']} expert, {policy['fusion_strategy']} fusion, step "
            f"{policy['step']}, {policy['parameters']:,} parameters, judged on "
            f"{comparison.ticks:,} held-out ticks of {len(comparison.episodes)} episode(s) of "
            f"{found.store.path.name}, {policy['samples']} chunk(s) a tick."
            f"{_beaten(comparison)}{_still(comparison)}"
        ),
        tiles=_tiles(comparison),
        sections=(
            Section("Errors beside baselines", _baselines(comparison)),
            Section("Dimensions and steps ahead", _dimensions(found)),
            Section("Episodes", episodes(found), tuple(extremes(found))),
            Section("Which streams are used", _modalities(found.study)),
            Section("Training", _training(found)),
            Section("What was judged", _documents(found)),
        ),
    )


def _beaten(comparison: Comparison) -> str:
    """A sentence on the groups in which a baseline is better, which the overall error hides."""
    worse = [
        f"{group.name} ({relative:.2f} times the best baseline's error)"
        for group in comparison.varying_groups()
        if (relative := comparison.relative(group)) is not None and round(relative, 2) > 1
    ]
    return f" A baseline is better in {', '.join(worse)}." if worse else ""


def _still(comparison: Comparison) -> str:
    """A sentence on the dimensions that hardly move, which the overall error counts like others."""
    said = still_dimensions(comparison)
    return f" {sentence(said)}" if said else ""


def _tiles(comparison: Comparison) -> list[tuple[str, str]]:
    tiles = [("overall error [training std]", f"{comparison.overall('policy'):.3f}")]
    ways = [("of the best baseline's", comparison)]
    if comparison.still():
        ways.append(("the same, without what hardly moves", comparison.without_still()))
    for said, judged in ways:
        if (relative := judged.relative()) is not None:
            tiles.append((f"{said} ({HEADINGS[best_baseline(judged)]})", f"{100 * relative:.0f} %"))
    tiles += [
        (with_unit(group.name, group.unit), f"{comparison.group_mae('policy', group):.3g}")
        for group in comparison.varying_groups()
    ]
    return [*tiles, ("held-out episodes", f"{len(comparison.episodes)}")]


def _baselines(comparison: Comparison) -> list[Block]:
    errors = error_table(comparison)
    return [
        Text(
            "Mean absolute errors over all steps of the chunk, of the policy and of three rules "
            "that see nothing. `overall` counts each channel in units of its training standard "
            "deviation; below 1, `policy / best` beats the best rule."
        ),
        Table(
            errors.columns,
            errors.rows,
            caption=sentence(FOOTNOTE),
            strong=frozenset({len(errors.rows) - 1}),
        ),
        Picture(
            "dimensions",
            "Mean absolute error of policy and baselines in each action dimension that varies.",
            partial(plots.dimensions, comparison),
        ),
    ]


def _dimensions(found: Evaluation) -> list[Block]:
    comparison = found.comparison
    columns = ["dimension", "unit", *(HEADINGS[method] for method in METHODS), "policy RMSE"]
    scores = comparison.scores
    rows = [
        (
            *(name, unit),
            *(float(scores[method].mae[index]) for method in METHODS),
            float(scores["policy"].rmse[index]),
        )
        for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True))
    ]
    return [
        Table(columns, rows, caption="Mean absolute error by dimension, and the policy's RMSE."),
        Picture(
            "scatter",
            "Predicted against recorded next action at the held-out ticks: on the line the policy "
            "does what was recorded; a cloud that lies flat says that it tells no cases apart.",
            partial(plots.scatter, comparison, found.predictions),
        ),
        _steps(comparison, found.store.action_hz),
        Picture(
            "horizon",
            "Mean absolute error of policy and baselines by how far ahead an action lies.",
            partial(plots.horizon, comparison, found.store.action_hz),
        ),
        Picture(
            "dimension_horizon",
            "The policy's error in each dimension (rows) and step of the chunk (columns), in units "
            "of the dimension's training standard deviation.",
            partial(plots.dimension_horizon, comparison),
        ),
    ]


def _steps(comparison: Comparison, action_hz: float | None) -> Table:
    """Errors of the policy and of the best baseline, a row a step of the chunk."""
    best, groups = best_baseline(comparison), comparison.varying_groups()
    columns = ["steps ahead", *([] if action_hz is None else ["ms ahead"])]
    for group in groups:
        columns += [with_unit(group.name, group.unit), HEADINGS[best]]
    errors = [
        group.mean(comparison.scores[method].mae_horizon).tolist()
        for group in groups
        for method in ("policy", best)
    ]
    rows = [
        (step, *([] if action_hz is None else [round(1000 * step / action_hz)]), *values)
        for step, values in enumerate(zip(*errors, strict=True))
    ]
    caption = (
        "The policy's mean absolute error by steps ahead, where 0 is the tick's own action; beside "
        f"each, that of the best baseline ({HEADINGS[best]})."
    )
    return Table(columns, rows, caption=caption)


def _modalities(study: AblationStudy | None) -> list[Block]:
    if study is None:
        return [
            Text(
                "Not judged: `evaluate.modalities` is off, or no held-out tick lies 200 ms into "
                "its episode."
            )
        ]
    errors = ablation_table(study)
    return [
        Text(
            f"{sentence(evaluated_on(study))} {sentence(ABLATION_FOOTNOTE)} An error that stays "
            "says that the policy does not use the stream, or that others tell it the same."
        ),
        Table(errors.columns, errors.rows, strong=errors.strong),
        *(Text(sentence(note)) for note in study.notes),
        Picture(
            "modalities",
            "The error with one stream ablated as a multiple of the error with all intact.",
            partial(plots.modalities, study),
        ),
    ]


def _training(found: Evaluation) -> list[Block]:
    if not found.curves.curves:
        return [Text(found.curves.absence)]
    return [
        Picture(
            "curves",
            "Loss on training batches, error on held-out ticks and learning rate over the steps "
            "of the training; dashed, the step of the checkpoint.",
            partial(plots.curves, found.curves, found.checkpoint.step),
        )
    ]


def _documents(found: Evaluation) -> list[Block]:
    checkpoint = found.checkpoint
    source = {key: value for key, value in checkpoint.source.items() if key != "feature_spec"}
    streams = {name: _shortened(said) for name, said in source.pop("streams").items()}
    return [
        Document(
            "train_head, as the checkpoint was trained", checkpoint.params.model_dump(mode="json")
        ),
        Document("Feature spec of its store", checkpoint.source["feature_spec"]),
        Document("Streams and ticks of its store", {**source, "streams": streams}),
        Document("What was judged, and on what (judged.json)", found.judged),
    ]


def _shortened(said: Any) -> Any:
    """A stream's names and units, the first few of many."""
    if isinstance(said, Mapping):
        return {key: _shortened(value) for key, value in said.items()}
    if isinstance(said, list) and len(said) > _NAMES:
        return [*said[:_NAMES], f"… {len(said)} in all"]
    return said
