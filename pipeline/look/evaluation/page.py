"""The page of an evaluation: how well a policy does, where it errs, and what it was made of."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial

from matplotlib.figure import Figure

from pipeline.base.digests import file_digest
from pipeline.base.table import Table
from pipeline.evaluate import tables
from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.baselines import METHODS
from pipeline.evaluate.episode_frames import read_episode_frames, shown_ticks
from pipeline.evaluate.evaluation import Evaluation, trained_on_too
from pipeline.evaluate.figures import NO_INTERVAL, best_baseline, rivalry
from pipeline.look.evaluation import pictures as plots
from pipeline.look.page.blocks import Block, Document, Picture, Report, Section, Text
from pipeline.look.page.writing import sentence
from pipeline.store import episode_name
from pipeline.train.batches import Ticks
from pipeline.train.predictions import Predictions
from pipeline.train.scores import Comparison

_INSTANTS = 5
"""Ticks of an episode at which its frames are shown."""
_EPISODES = 40
"""Rows of the table of episodes."""
_PAIRED = (
    "Policy minus best baseline in each figure, by the paired bootstrap over groups of test "
    "recordings: not resolved is a difference whose 95 % interval holds 0."
)
_CAPTIONS = {
    "methods": "Overall error of policy and baselines, of what is executed and of the whole chunk, "
    "with 95 % intervals where there are two groups of test recordings or more.",
    "scatter": "Predicted against recorded next action at the test ticks.",
    "horizon": "Mean absolute error of policy and baselines by how far ahead an action lies; the "
    "bands of the policy and of the best baseline, where there are some, are 95 % intervals.",
    "dimension_horizon": "The policy's error by dimension and step [training std].",
    "modalities": "The error with one stream ablated as a multiple of that with all intact.",
    "curves": "The training by its steps; dashed, the step of the checkpoint.",
}


def evaluation_report(evaluation: Evaluation, rollout: str = "") -> Report:
    """The page of a judgement, its recordings' frames read where they still lie.

    `rollout` is the page of the closed loop, relative to this one, where there is one. Says nothing
    of the clock and nothing of where it is written: the same judgement gives the same page.
    """
    comparison, policy = evaluation.comparison, evaluation.judged["policy"]
    # The overall error counts dimensions that hardly move like the others.
    still = tables.still_dimensions(comparison)
    notes = [note for note in (trained_on_too(evaluation.checkpoint), still) if note]
    return Report(
        title=f"Evaluation of {evaluation.name}",
        summary=(
            f"{policy['model_type']} expert, {policy['fusion_strategy']} fusion, step "
            f"{policy['step']}, {policy['parameters']:,} parameters, judged on "
            f"{comparison.ticks:,} test ticks of {len(comparison.episodes)} episode(s) of "
            f"{evaluation.store.path.name}, {policy['samples']} chunk(s) a tick."
            f"{''.join(f' {sentence(note)}' for note in notes)}"
        ),
        tiles=_tiles(comparison),
        sections=(
            Section("Error of what is executed", _executed(comparison, rollout)),
            Section("Error of the whole chunk", _chunk(evaluation)),
            *([Section("Phases", _phases(comparison))] if tables.by_phase(comparison) else []),
            Section("Dimensions and steps ahead", _dimensions(evaluation)),
            Section("Episodes", _episodes(evaluation), tuple(_extremes(evaluation))),
            Section("Which streams are used", _modalities(evaluation.study)),
            Section("Training", _training(evaluation)),
            Section("What was judged", _documents(evaluation)),
        ),
    )


def _picture(draw: Callable[..., Figure], *shown: object) -> Picture:
    """A picture that is called like the function that draws it."""
    return Picture(draw.__name__, _CAPTIONS[draw.__name__], partial(draw, *shown))


def _tiles(comparison: Comparison) -> list[tuple[str, str]]:
    tiles: list[tuple[str, str]] = []
    for scope, part in (("executed", comparison.executed), ("chunk", comparison)):
        rivals = rivalry(part)
        best = tables.HEADINGS[rivals.best]
        value, _, ends = rivals.policy.text().partition(" ")
        tiles.append((f"{scope}: overall error [training std] {ends}", value))
        label = f"{scope}: {rivals.difference.text('+')} beside the best baseline ({best})"
        headline = rivals.verdict
        if rivals.difference.resolved is None and rivals.ratio is not None:
            label += f"; {NO_INTERVAL}"
            headline = f"{rivals.ratio:.3g} times the error of {best}"
        tiles.append((label, headline))
    return [*tiles, ("test episodes", f"{len(comparison.episodes)}")]


def _executed(comparison: Comparison, rollout: str) -> list[Block]:
    title, _ = tables.titles(comparison)
    errors = tables.error_table(comparison.executed)
    success = "Whether the task succeeds, recorded ticks do not tell"
    return [
        Text(f"{sentence(title)} {sentence(tables.verdicts(comparison))}"),
        replace(errors, caption=sentence(tables.FOOTNOTE)),
        _picture(plots.methods, comparison),
        Text(f"{success}: the rollouts do." if rollout else f"{success}.", rollout),
    ]


def _chunk(evaluation: Evaluation) -> list[Block]:
    comparison = evaluation.comparison
    _, title = tables.titles(comparison)
    return [
        replace(tables.error_table(comparison), caption=sentence(title)),
        Text(sentence(tables.samples_text(comparison, evaluation.energy))),
        replace(tables.difference_table(comparison), caption=_PAIRED),
    ]


def _phases(comparison: Comparison) -> list[Block]:
    caption = f"Overall error [training std] by phase. {sentence(tables.PHASE_RULE)}"
    return [replace(tables.phase_table(comparison), caption=caption)]


def _dimensions(evaluation: Evaluation) -> list[Block]:
    """Over the whole chunk."""
    comparison = evaluation.comparison
    columns = ["dimension", "unit", *(tables.HEADINGS[method] for method in METHODS)]
    errors = [comparison.scores[method].mae for method in METHODS]
    rows = list(zip(comparison.names, comparison.units, *errors, strict=True))
    return [
        Table(columns, rows, caption="Mean absolute error by dimension."),
        _picture(plots.scatter, comparison, evaluation.predictions),
        _picture(plots.horizon, comparison, evaluation.store.action_hz),
        _picture(plots.dimension_horizon, comparison),
    ]


def _episodes(evaluation: Evaluation) -> list[Block]:
    """All test episodes by error."""
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
    heads = ["episode", "test ticks", "policy", tables.HEADINGS[best], "policy / baseline"]
    return [Table(heads, rows, f"{caption}.")]


def _extremes(evaluation: Evaluation) -> Iterator[Section]:
    """The best and the worst closely, with their frames where the recordings still lie there.

    The picture of a single one is that of the worst, which dvc.yaml lists.
    """
    comparison, predictions, store = evaluation.comparison, evaluation.predictions, evaluation.store
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
            "the policy's next action at every tick, and its whole chunks at the dotted ticks."
        )
        called = "episode_worst" if index == worst else "episode_best"
        shown = comparison, predictions, store, episode, ticks, seen.frames
        picture = Picture(called, caption, partial(plots.chunks, *shown))
        name = f"{title[0].upper()}{title[1:]}: {episode_name(episode)}"
        yield Section(name, [*([Text(seen.absence)] if seen.absence else []), picture])


def _whole(predictions: Predictions, index: int) -> Ticks:
    """The judged ticks of an episode whose chunk ends within it; all, where it is that short."""
    here = predictions.episodes == index
    whole = here & predictions.valid.all(axis=1)
    return predictions.ticks[whole if whole.any() else here]


def _modalities(study: AblationStudy | None) -> list[Block]:
    if study is None:
        return [Text("Not judged: `evaluate.modalities` is off, or no episode is long enough.")]
    return [
        Text(f"{sentence(tables.evaluated_on(study))} {sentence(tables.ABLATION_FOOTNOTE)}"),
        replace(tables.ablation_table(study), caption=""),
        *(Text(sentence(note)) for note in study.notes),
        _picture(plots.modalities, study),
    ]


def _training(evaluation: Evaluation) -> list[Block]:
    if not evaluation.curves.curves:
        return [Text(evaluation.curves.absence)]
    return [_picture(plots.curves, evaluation.curves, evaluation.checkpoint.step)]


def _documents(evaluation: Evaluation) -> list[Block]:
    checkpoint = evaluation.checkpoint
    source = {key: value for key, value in checkpoint.source.items() if key != "feature_spec"}
    return [
        Document("train_head, as trained", checkpoint.params.model_dump(mode="json")),
        Document("Feature spec of its store", checkpoint.source["feature_spec"]),
        Document("Streams and ticks of its store", source),
        Document("What was judged, and on what (judged.json)", evaluation.judged),
    ]
