"""The page of an evaluation: how well a policy does, where it errs, and what it was made of."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pipeline.base.digests import file_digest
from pipeline.base.text import Table
from pipeline.evaluate import tables
from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.baselines import METHODS
from pipeline.evaluate.evaluation import Evaluation, trained_on_too
from pipeline.evaluate.figures import NO_INTERVAL, best_baseline, error, rivalry, with_unit
from pipeline.evaluate.figures import Figure as Merit
from pipeline.evaluate.sources import TrainingCurves, read_episode_frames, shown_ticks
from pipeline.look.page.blocks import Block, Outline, Picture, Report, Section, Text, next_steps
from pipeline.look.page.style import (
    INK,
    PALETTE,
    canvas,
    draw_map,
    draw_strip,
    finish,
    logarithmic,
    panels,
    shorten_middle,
)
from pipeline.look.page.writing import sentence
from pipeline.store import Episode, FeatureStore, episode_name
from pipeline.train.batches import Ticks
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison

LABELS = {way: f"baseline: {words}" for way, words in tables.HEADINGS.items()} | {
    "policy": "policy"
}
"""Legend entry of each method."""
STYLES: dict[str, dict[str, Any]] = {
    "policy": {"color": "#0072B2", "marker": "o", "ls": "-", "zorder": 5, "lw": 2.4, "ms": 6.5},
    # An open, larger square stays visible when the median action is almost no motion.
    "zero_action": {"color": "#E69F00", "marker": "s", "ls": "--", "fillstyle": "none", "ms": 8.5},
    "median_action": {"color": "#009E73", "marker": "^", "ls": "-."},
    "repeat_last": {"color": "#CC79A7", "marker": "D", "ls": ":"},
    "linear_fit": {"color": "#D55E00", "marker": "v", "ls": "-."},
    "nearest_neighbour": {"color": "#56B4E9", "marker": "P", "ls": "--"},
}
SCATTER_POINTS = 4000
_CHUNKS_WIDTH = 11.0
_CHUNK = PALETTE[5]
"""Colour of whole chunks."""
_NUMBERED_STEPS = 16
"""The most steps of a chunk with which a cell has room for its number."""
_POLICY = STYLES["policy"]["color"]
_CURVES = {
    "train/loss": ("training loss", PALETTE[0]),
    "val/error": ("val error [training std]", PALETTE[5]),
    "lr": ("learning rate", PALETTE[2]),
}
"""Training curve -> title and colour."""
_FEW = 10
"""Fewer groups of test recordings say little."""
_DOING = {
    "zero_action": "standing still",
    "median_action": "the median action",
    "repeat_last": "repeating the last action",
    "linear_fit": "a linear fit on the two past actions",
    "nearest_neighbour": "copying the nearest neighbour",
}
"""The baselines, as a sentence has them."""
_INSTANTS = 5
"""Ticks of an episode at which its frames are shown."""
_EPISODES = 40
"""The most rows of the table of episodes."""
_PAIRED = (
    "Policy minus best baseline in each figure, by the paired bootstrap over groups of test "
    "recordings: not resolved is a difference whose 95 % interval holds 0."
)


def evaluation_report(evaluation: Evaluation, rollout: str = "") -> Report:
    """The page of an evaluation, with frames of its recordings if these are still there.

    `rollout` is the path from this page to the page of the rollouts, if there is one. The same
    evaluation gives the same page: it names neither the time nor its own folder.
    """
    comparison, policy = evaluation.comparison, evaluation.judged["policy"]
    # The overall error counts dimensions that hardly move like the others.
    still = tables.still_dimensions(comparison)
    notes = [note for note in (trained_on_too(evaluation.checkpoint), still) if note]
    return Report(
        title=f"Evaluation of {evaluation.name}",
        verdict=_verdict(comparison, bool(evaluation.checkpoint.shape.anchors)),
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
            next_steps(*_advice(evaluation, rollout)),
        ),
    )


def _verdict(comparison: Comparison, anchored: bool) -> str:
    """The policy's executed steps beside the best baseline, in words."""
    rivals = rivalry(comparison.executed)
    best = _DOING[rivals.best]
    if rivals.ratio is None or rivals.difference.resolved is False:
        return f"Not told apart from {best}, in what is executed"
    if rivals.ratio <= 1:
        return f"In what is executed, the policy errs {_times(1 / rivals.ratio)} less than {best}"
    worse = f"In what is executed, the policy is {_times(rivals.ratio)} worse than {best}"
    return worse + ", as an anchored policy may be" * anchored


def _times(ratio: float) -> str:
    """`3.2 times`; `8 %` for less than twice."""
    return f"{ratio - 1:.0%}" if ratio < 2 else f"{ratio:.2g} times"


def _advice(evaluation: Evaluation, rollout: str) -> Iterator[str]:
    executed = evaluation.comparison.executed
    rivals, groups = rivalry(executed), len(np.unique(executed.cells.group))
    if rivals.verdict != "better" and evaluation.checkpoint.shape.anchors:
        yield (
            "The policy is anchored: it errs more at its first step on purpose (docs/late.md), so "
            "judge it by rollouts."
        )
    elif rivals.verdict != "better":
        yield (
            "Look above at which streams are used and at the training curve, then go through "
            "docs/worse.md: it says which switch first."
        )
    if groups < _FEW:
        yield (
            f"Hold out more: {groups} group(s) of test recordings leave wide intervals, or none. "
            "Five folds test each recording once (docs/training.md)."
        )
    if rollout:
        yield "See the rollouts: whether the task succeeds, errors cannot tell."
    elif rivals.verdict == "better":
        yield "Count successes: `vla-cache rollout` in a simulation, `vla-cache drive` on an arm."


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
    caption = (
        "Overall error of policy and baselines, of what is executed and of the whole chunk, with "
        "95 % intervals where there are two groups of test recordings or more."
    )
    success = "Whether the task succeeds, recorded ticks do not tell"
    return [
        Text(f"{sentence(title)} {sentence(tables.verdicts(comparison))}"),
        replace(errors, caption=sentence(tables.FOOTNOTE)),
        Picture("methods", caption, partial(draw_methods, comparison)),
        Text(f"{success}: stages.rollout does." if rollout else f"{success}.", rollout),
    ]


def draw_methods(comparison: Comparison) -> Figure:
    """The overall error of policy and baselines with 95 % intervals, executed and whole chunk."""
    scopes = {"what is executed": comparison.executed, "the whole chunk": comparison}
    figure, axes = panels(9.4, 3.6, 1, len(scopes), sharey=True)
    for axis, (title, part) in zip(axes, scopes.items(), strict=True):
        for place, method in enumerate(METHODS):
            draw_bar(axis, place, error(part, method), 0.7, color=STYLES[method]["color"])
        axis.set(title=title, xlabel="mean absolute error [training std]")
        axis.grid(axis="y", visible=False)
    axes[0].set_yticks(range(len(METHODS)), [tables.HEADINGS[method] for method in METHODS])
    axes[0].invert_yaxis()
    figure.suptitle("Overall error on test ticks (left is better)")
    return figure


def draw_bar(axis: Axes, place: int, merit: Merit, height: float, **style: Any) -> None:
    """Draw a bar to the right, and its interval if it has one."""
    axis.barh(place, merit.value, height, **style)
    if merit.low is not None and merit.high is not None:
        axis.plot([merit.low, merit.high], [place, place], color=INK, lw=1.6, marker="|")


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
    """Errors over the whole chunk, by dimension and by step."""
    comparison = evaluation.comparison
    columns = ["dimension", "unit", *(tables.HEADINGS[method] for method in METHODS)]
    errors = [comparison.scores[method].mae for method in METHODS]
    rows = list(zip(comparison.names, comparison.units, *errors, strict=True))
    predictions, hz = evaluation.predictions, evaluation.store.action_hz
    scatter = "Predicted against recorded next action at the test ticks."
    horizon = (
        "Mean absolute error of policy and baselines by how far ahead an action lies; the bands of "
        "the policy and of the best baseline, where there are some, are 95 % intervals."
    )
    cells = "The policy's error by dimension and step [training std]."
    return [
        Table(columns, rows, caption="Mean absolute error by dimension."),
        Picture("scatter", scatter, partial(draw_scatter, comparison, predictions)),
        Picture("horizon", horizon, partial(draw_horizon, comparison, hz)),
        Picture("dimension_horizon", cells, partial(draw_dimension_horizon, comparison)),
    ]


def draw_scatter(comparison: Comparison, predictions: Predictions) -> Figure:
    """Predicted against recorded next action, a panel for each dimension; the diagonal is right."""
    shown = comparison.varying()
    columns = min(4, len(shown))
    lines = math.ceil(len(shown) / columns)
    figure, axes = panels(3.1 * columns, 3.1 * lines + 0.5, lines, columns, squeeze=False)
    step = math.ceil(len(predictions.ticks) / SCATTER_POINTS)
    for axis in axes.flat[len(shown) :]:
        axis.set_axis_off()
    for index, axis in zip(shown, axes.flat, strict=False):
        recorded = predictions.recorded[::step, 0, index]
        predicted = predictions.predicted[::step, 0, index]
        both = np.concatenate([recorded, predicted])
        low, high = float(both.min()), float(both.max())
        margin = max(0.05 * (high - low), 0.02 * max(abs(low), abs(high)), 1e-6)
        low, high = low - margin, high + margin
        axis.axline((low, low), slope=1, color=INK, lw=1, zorder=1)
        axis.scatter(recorded, predicted, s=9, alpha=0.35, linewidths=0, color=_POLICY)
        axis.set(xlim=(low, high), ylim=(low, high), aspect="equal")
        axis.locator_params(nbins=4)
        axis.ticklabel_format(scilimits=(-2, 4), useOffset=False)
        name, unit = comparison.names[index], comparison.units[index]
        axis.set(xlabel=with_unit("recorded", unit), ylabel=with_unit("policy", unit))
        axis.set_title(with_unit(name, unit))
    figure.suptitle("Next action at test ticks: on the line, the policy does what was recorded")
    return figure


def draw_horizon(comparison: Comparison, action_hz: float | None) -> Figure:
    """Mean absolute error by steps ahead, with a panel for each action group."""
    ahead = "steps ahead" if action_hz is None else f"steps ahead [{1000 / action_hz:.0f} ms each]"
    groups = comparison.varying_groups()
    figure, (axes,) = panels(max(4.6 * len(groups), 9.4), 4.4, 1, len(groups), squeeze=False)
    for axis, group in zip(axes, groups, strict=True):
        for method in METHODS:
            errors = group.mean(comparison.scores[method].mae_horizon)
            style = {"lw": 1.5, "ms": 5, "label": LABELS[method]} | STYLES[method]
            axis.plot(np.arange(len(errors)), errors, **style)
        for method in ("policy", best_baseline(comparison, group)):
            _draw_band(axis, comparison, method, group)
        axis.set(title=f"{group.name}, {len(group.dimensions)} dimension(s)", xlabel=ahead)
        axis.set_ylabel(with_unit("mean absolute error", group.unit))
        axis.set_ylim(bottom=0)
        axis.xaxis.get_major_locator().set_params(integer=True)
    finish(figure, axes[0], 3, "Error over the action chunk (lower is better)")
    return figure


def _draw_band(axis: Axes, comparison: Comparison, method: str, group: ActionGroup) -> None:
    """Draw the 95 % interval of a group's error at each step."""
    steps = range(comparison.cells.entries.shape[1])
    parts = (comparison.part(steps=slice(step, step + 1)) for step in steps)
    errors = [error(part, method, group) for part in parts]
    low, high = np.array([(step.low, step.high) for step in errors], float).T
    axis.fill_between(steps, low, high, color=STYLES[method]["color"], alpha=0.18, lw=0)


def draw_dimension_horizon(comparison: Comparison) -> Figure:
    """The policy's error over dimensions and steps ahead, each in its training deviation."""
    errors = comparison.in_training_std(comparison.scores["policy"].mae_horizon).T
    figure, axis = panels(9.0, 0.42 * len(errors) + 1.9)
    limits = (0, float(np.nanmax(errors)) or 1.0)
    image = draw_map(axis, errors, limits, "viridis_r", errors.shape[1] <= _NUMBERED_STEPS)
    figure.colorbar(image, ax=axis, pad=0.02, label="error [training std]")
    names = [with_unit(comparison.names[i], comparison.units[i]) for i in comparison.varying()]
    axis.set_yticks(range(len(errors)), names)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set_xlabel("steps ahead")
    figure.suptitle("Error of the policy by dimension and step of the chunk (light is better)")
    return figure


def _episodes(evaluation: Evaluation) -> list[Block]:
    """The test episodes, the worst first."""
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
    """The best and the worst episode in detail, with frames if their recordings are still there.

    A single episode's picture has the name of the worst one's, because dvc.yaml lists that.
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
        picture = Picture(called, caption, partial(draw_chunks, *shown))
        name = f"{title[0].upper()}{title[1:]}: {episode_name(episode)}"
        yield Section(name, [*([Text(seen.absence)] if seen.absence else []), picture])


def _whole(predictions: Predictions, index: int) -> Ticks:
    """The judged ticks of an episode whose chunk ends within it; all of a very short episode."""
    here = predictions.episodes == index
    whole = here & predictions.valid.all(axis=1)
    return predictions.ticks[whole if whole.any() else here]


def draw_chunks(
    comparison: Comparison,
    predictions: Predictions,
    store: FeatureStore,
    episode: Episode,
    instants: NDArray[np.int64],
    frames: Mapping[str, Sequence[NDArray[np.uint8]]],
) -> Figure:
    """Frames at `instants` above, and below them recorded and predicted actions over time.

    `instants` are test ticks of the episode, store-global; `frames` has one of each view for each
    instant, or no view at all. The picture shows the next action at every tick, and the whole chunk
    at the instants.
    """
    time_s = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    time_s = time_s - time_s[0]
    here = predictions.episodes == episode.index
    at = time_s[predictions.ticks[here] - episode.ticks.start]
    shown = comparison.varying()
    width = _CHUNKS_WIDTH / max(3, len(instants))
    shapes = [[image.shape for image in images] for images in frames.values()]
    heights = [width * max(shape[0] / shape[1] for shape in view) for view in shapes]
    heights += [1.15] * len(shown)
    figure = canvas(_CHUNKS_WIDTH, sum(heights) + 1.7)
    grid = figure.add_gridspec(len(heights), len(instants), height_ratios=heights)
    draw_strip(figure, grid, frames, time_s[instants - episode.ticks.start].tolist())
    axes: list[Axes] = []
    places = np.flatnonzero(np.isin(predictions.ticks, instants))
    for row, dimension in enumerate(shown, len(frames)):
        axis = figure.add_subplot(grid[row, :], sharex=axes[0] if axes else None)
        axes.append(axis)
        recorded, predicted = predictions.recorded[here, 0], predictions.predicted[here, 0]
        axis.plot(at, recorded[:, dimension], color=INK, lw=2.2, label="recorded")
        axis.plot(at, predicted[:, dimension], color=_POLICY, lw=1.6, label="policy, next action")
        axis.set_ylabel(with_unit(comparison.names[dimension], comparison.units[dimension]))
        label = "policy, whole chunk at the dotted ticks"
        for place in places:
            chunk = predictions.predicted[place, predictions.valid[place], dimension]
            ahead = time_s[predictions.ticks[place] - episode.ticks.start :][: len(chunk)]
            axis.axvline(ahead[0], color=INK, lw=0.8, ls=":", zorder=1)
            axis.plot(ahead, chunk, color=_CHUNK, lw=2, zorder=6, label=label)
            axis.plot(ahead[0], chunk[0], color=_CHUNK, marker="o", ms=5, zorder=6)
            label = ""
        axis.label_outer()
    axes[-1].set_xlabel("time since the episode began [s]")
    figure.align_ylabels(axes)
    overall = comparison.overall_by_episode("policy")[comparison.episodes.index(episode.index)]
    name = shorten_middle(episode_name(episode), 14, 28)
    finish(figure, axes[0], 3, f"{name}: overall error {overall:.3f} [training std]")
    return figure


def _modalities(study: AblationStudy | None) -> list[Block]:
    if study is None:
        return [Text("Not judged: `evaluate.modalities` is off, or no episode is long enough.")]
    caption = "The error with one stream ablated as a multiple of that with all intact."
    return [
        Text(f"{sentence(tables.evaluated_on(study))} {sentence(tables.ABLATION_FOOTNOTE)}"),
        replace(tables.ablation_table(study), caption=""),
        *(Text(sentence(note)) for note in study.notes),
        Picture("modalities", caption, partial(draw_modalities, study)),
    ]


def draw_modalities(study: AblationStudy) -> Figure:
    """The error with each stream ablated as a multiple of the intact one, with 95 % intervals."""
    figure, axis = panels(9.4, 0.34 * len(study.ablated) + 2)
    for place, way in enumerate(study.ablated):
        if times := study.times_intact(way):
            draw_bar(axis, place, times, 0.7, color=_CHUNK)
    names = [f"{way.stream} {way.how}" for way in study.ablated]
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.grid(axis="y", visible=False)
    axis.axvline(1, color=_POLICY, lw=1.8, label="policy, all streams intact")
    best, intact = best_baseline(study.intact), study.intact.overall("policy")
    if intact > 0:
        blind = study.intact.overall(best) / intact
        axis.axvline(blind, color=INK, lw=1.8, ls="--", label=f"best {LABELS[best]}")
    axis.set_xlabel("test error / error with all streams intact (left is better)")
    finish(figure, axis, 2, "What the policy loses with one stream ablated")
    return figure


def _training(evaluation: Evaluation) -> list[Block]:
    if not evaluation.curves.curves:
        return [Text(evaluation.curves.absence)]
    caption = "The training by its steps; dashed, the step of the checkpoint."
    draw = partial(draw_curves, evaluation.curves, evaluation.checkpoint.step)
    return [Picture("curves", caption, draw)]


def draw_curves(logged: TrainingCurves, step: int) -> Figure:
    """Loss, val error and learning rate over the steps; a line marks the step judged here."""
    shown = [name for name in _CURVES if name in logged.curves] or sorted(logged.curves)[:3]
    size = max(4.2 * len(shown), 8.4), 3.4
    figure, (axes,) = panels(*size, 1, len(shown), squeeze=False, sharex=True)
    for axis, name in zip(axes, shown, strict=True):
        curve, (title, colour) = logged.curves[name], _CURVES.get(name, (name, PALETTE[4]))
        marker = "o" if len(curve.step) <= 30 else ""
        axis.plot(curve.step, curve.value, color=colour, marker=marker, markersize=4)
        # Within one decade, the labels of a logarithmic axis would be odd numbers.
        if 0 < 10 * curve.value.min() <= curve.value.max():
            logarithmic(axis)
        else:
            axis.set_ylim(bottom=min(0.0, float(curve.value.min())))
        axis.set(title=title, xlabel="step")
        axis.axvline(step, color=INK, lw=1, ls="--")
    figure.suptitle(f"Course of the training; the checkpoint judged here is of step {step}")
    return figure


def _documents(evaluation: Evaluation) -> list[Block]:
    checkpoint = evaluation.checkpoint
    source = {key: value for key, value in checkpoint.source.items() if key != "feature_spec"}
    return [
        Outline("train_head, as trained", checkpoint.params.model_dump(mode="json")),
        Outline("Feature spec of its store", checkpoint.source["feature_spec"]),
        Outline("Streams and ticks of its store", source),
        Outline("What was judged, and on what (judged.json)", evaluation.judged),
    ]
