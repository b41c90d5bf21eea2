"""The page of an evaluation: how well a policy does, where it errs, and what it was made of."""

from collections.abc import Iterator, Mapping
from functools import cache, partial
from typing import Any

from pipeline.base.digests import file_digest
from pipeline.base.table import Table
from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.episode_frames import read_episode_frames, shown_ticks
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
from pipeline.look.page.blocks import Block, Document, Picture, Report, Section, Text
from pipeline.look.page.writing import sentence
from pipeline.store import episode_name
from pipeline.train.batches import Ticks
from pipeline.train.predictions import METHODS, Predictions
from pipeline.train.scores import Comparison

_INSTANTS = 5
"""Ticks of an episode at which its frames are shown."""
_EPISODES = 40
"""Rows of the table of episodes."""
_NAMES = 8
"""Channels of a stream named in the params; an A-scan has a thousand."""


def evaluation_report(evaluation: Evaluation) -> Report:
    """The page of a judgement, its recordings' frames read where they still lie.

    Says nothing of the clock and nothing of where it is written: the same judgement gives the same
    page.
    """
    comparison, policy = evaluation.comparison, evaluation.judged["policy"]
    return Report(
        title=f"Evaluation of {evaluation.name}",
        summary=(
            f"{policy['model_type']} expert, {policy['fusion_strategy']} fusion, step "
            f"{policy['step']}, {policy['parameters']:,} parameters, judged on "
            f"{comparison.ticks:,} held-out ticks of {len(comparison.episodes)} episode(s) of "
            f"{evaluation.store.path.name}, {policy['samples']} chunk(s) a tick."
            f"{_beaten(comparison)}{_still(comparison)}"
        ),
        tiles=_tiles(comparison),
        sections=(
            Section("Errors beside baselines", _baselines(comparison)),
            Section("Dimensions and steps ahead", _dimensions(evaluation)),
            Section("Episodes", _episodes(evaluation), tuple(_extremes(evaluation))),
            Section("Which streams are used", _modalities(evaluation.study)),
            Section("Training", _training(evaluation)),
            Section("What was judged", _documents(evaluation)),
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
    words = still_dimensions(comparison)
    return f" {sentence(words)}" if words else ""


def _tiles(comparison: Comparison) -> list[tuple[str, str]]:
    tiles = [("overall error [training std]", f"{comparison.overall('policy'):.3f}")]
    ways = [("of the best baseline's", comparison)]
    if comparison.still():
        ways.append(("the same, without what hardly moves", comparison.without_still()))
    for words, judged in ways:
        if (relative := judged.relative()) is not None:
            tiles.append(
                (f"{words} ({HEADINGS[best_baseline(judged)]})", f"{100 * relative:.0f} %")
            )
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


def _dimensions(evaluation: Evaluation) -> list[Block]:
    comparison = evaluation.comparison
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
            partial(plots.scatter, comparison, evaluation.predictions),
        ),
        _steps(comparison, evaluation.store.action_hz),
        Picture(
            "horizon",
            "Mean absolute error of policy and baselines by how far ahead an action lies.",
            partial(plots.horizon, comparison, evaluation.store.action_hz),
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


def _episodes(evaluation: Evaluation) -> list[Block]:
    """All held-out episodes by error."""
    comparison, store = evaluation.comparison, evaluation.store
    best = best_baseline(comparison)
    errors = {method: comparison.overall_by_episode(method) for method in ("policy", best)}
    rows: list[tuple[object, ...]] = []
    for place in comparison.ranked()[::-1][:_EPISODES]:
        episode = store.episodes[comparison.episodes[place]]
        policy, rule = (float(errors[method][place]) for method in ("policy", best))
        ticks = int((evaluation.predictions.episodes == episode.index).sum())
        rows.append((episode_name(episode), ticks, policy, rule, policy / rule if rule else None))
    caption = "Overall error [training std] by episode, the worst first"
    if len(rows) < len(comparison.episodes):
        caption += f"; the worst {len(rows)} of {len(comparison.episodes)}"
    heads = ["episode", "held-out ticks", "policy", HEADINGS[best], "policy / baseline"]
    return [
        Table(heads, rows, f"{caption}."),
        Picture(
            "episodes",
            "Mean absolute error of policy and baselines in each held-out episode.",
            partial(plots.episodes, comparison, store),
        ),
        Picture(
            "timeline",
            "Every action dimension over the episodes of lowest and highest error: recorded, and "
            "what the policy would do next.",
            partial(plots.timeline, comparison, evaluation.predictions, store),
        ),
    ]


def _extremes(evaluation: Evaluation) -> Iterator[Section]:
    """The best and the worst closely, with their frames where the recordings still lie there.

    The picture of a single one is that of the worst, which dvc.yaml lists.
    """
    comparison, predictions, store = evaluation.comparison, evaluation.predictions, evaluation.store
    errors = dict(zip(comparison.episodes, comparison.overall_by_episode("policy"), strict=True))
    digest_of = cache(file_digest)  # episodes of a LeRobot data set share files
    *_, (_, worst) = comparison.extremes()
    for title, index in comparison.extremes():
        episode = store.episodes[index]
        ticks = shown_ticks(store, _whole(predictions, index), _INSTANTS)
        rows = store.array("tick/vl_row")[ticks]
        seen = read_episode_frames(store, episode, rows.tolist(), evaluation.recordings, digest_of)
        above = "Above, the frames that the features at the dotted ticks were computed from. "
        caption = (
            f"Instruction: {episode.instruction}. {above if seen.frames else ''}Recorded action, "
            "the policy's next action at every tick, and the whole chunks that it predicts at the "
            "dotted ticks; what was recorded then is the recorded line from there on."
        )
        picture = Picture(
            "episode_worst" if index == worst else "episode_best",
            caption,
            partial(plots.chunks, comparison, predictions, store, episode, ticks, seen.frames),
        )
        words = f"Overall error {errors[index]:.3f} [training std]. {seen.absence}".strip()
        name = f"{title[0].upper()}{title[1:]}: {episode_name(episode)}"
        yield Section(name, [Text(words), picture])


def _whole(predictions: Predictions, index: int) -> Ticks:
    """The judged ticks of an episode whose chunk ends within it; all, where it is that short."""
    here = predictions.episodes == index
    whole = here & predictions.valid.all(axis=1)
    return predictions.ticks[whole if whole.any() else here]


def _modalities(study: AblationStudy | None) -> list[Block]:
    if study is None:
        return [
            Text(
                "Not judged: `evaluate.modalities` is off, or no held-out tick lies 200 ms into "
                "its episode."
            )
        ]
    table = ablation_table(study)
    return [
        Text(
            f"{sentence(evaluated_on(study))} {sentence(ABLATION_FOOTNOTE)} An error that stays "
            "says that the policy does not use the stream, or that others tell it the same."
        ),
        Table(table.columns, table.rows, strong=frozenset({0})),
        *(Text(sentence(note)) for note in study.notes),
        Picture(
            "modalities",
            "The error with one stream ablated as a multiple of the error with all intact.",
            partial(plots.modalities, study),
        ),
    ]


def _training(evaluation: Evaluation) -> list[Block]:
    if not evaluation.curves.curves:
        return [Text(evaluation.curves.absence)]
    return [
        Picture(
            "curves",
            "Loss on training batches, error on held-out ticks and learning rate over the steps "
            "of the training; dashed, the step of the checkpoint.",
            partial(plots.curves, evaluation.curves, evaluation.checkpoint.step),
        )
    ]


def _documents(evaluation: Evaluation) -> list[Block]:
    checkpoint = evaluation.checkpoint
    source = {key: value for key, value in checkpoint.source.items() if key != "feature_spec"}
    streams = {name: _shortened(words) for name, words in source.pop("streams").items()}
    return [
        Document(
            "train_head, as the checkpoint was trained", checkpoint.params.model_dump(mode="json")
        ),
        Document("Feature spec of its store", checkpoint.source["feature_spec"]),
        Document("Streams and ticks of its store", {**source, "streams": streams}),
        Document("What was judged, and on what (judged.json)", evaluation.judged),
    ]


def _shortened(words: Any) -> Any:
    """A stream's names and units, the first few of many."""
    if isinstance(words, Mapping):
        return {key: _shortened(value) for key, value in words.items()}
    if isinstance(words, list) and len(words) > _NAMES:
        return [*words[:_NAMES], f"… {len(words)} in all"]
    return words
