"""Figures of merit -> pictures; the same numbers give the same bytes."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pipeline.evaluate.ablation import Ablated, AblationStudy
from pipeline.evaluate.baselines import METHODS
from pipeline.evaluate.curves import TrainingCurves
from pipeline.evaluate.figures import best_baseline, error
from pipeline.evaluate.names import with_unit
from pipeline.evaluate.tables import ABLATION_FOOTNOTE, HEADINGS
from pipeline.look.page.style import (
    GRID,
    INK,
    PALETTE,
    canvas,
    draw_frame,
    draw_map,
    finish,
    logarithmic,
    panels,
    shorten_middle,
)
from pipeline.store import Episode, FeatureStore, episode_name
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison

LABELS = {way: f"baseline: {words}" for way, words in HEADINGS.items()} | {"policy": "policy"}
"""What legends say of each method."""
STYLES: dict[str, dict[str, Any]] = {
    "policy": {"color": "#0072B2", "marker": "o", "ls": "-", "zorder": 5, "lw": 2.4, "ms": 6.5},
    # An open, larger square stays visible where the median action is next to no motion.
    "zero_action": {"color": "#E69F00", "marker": "s", "ls": "--", "fillstyle": "none", "ms": 8.5},
    "median_action": {"color": "#009E73", "marker": "^", "ls": "-."},
    "repeat_last": {"color": "#CC79A7", "marker": "D", "ls": ":"},
    "linear_fit": {"color": "#D55E00", "marker": "v", "ls": "-."},
    "nearest_neighbour": {"color": "#56B4E9", "marker": "P", "ls": "--"},
}
SCATTER_POINTS = 4000
EPISODE_LINES = 40
_TITLE_WIDTH = 34
"""Characters for which a panel of an action group has room."""
_CHUNKS_WIDTH = 11.0
_CHUNK = PALETTE[5]
"""Of whole chunks."""
_NUMBERED_STEPS = 16
"""Steps of a chunk up to which a cell has room for its number."""
_POLICY = STYLES["policy"]["color"]
_CURVES = {
    "train/loss": ("training loss", PALETTE[0]),
    "val/error": ("val error [training std]", PALETTE[5]),
    "lr": ("learning rate", PALETTE[2]),
}
"""TrainingCurve -> what its axis says, and its colour."""
_ABLATIONS = {
    "zeroed": "#0072B2",
    "missing": "#56B4E9",
    "shuffled": "#D55E00",
    "delayed": "#999999",
}


def methods(comparison: Comparison) -> Figure:
    """The overall error of policy and baselines with 95 % intervals, executed and whole chunk."""
    scopes = {"what is executed": comparison.executed, "the whole chunk": comparison}
    figure, axes = panels(9.4, 3.6, 1, len(scopes), sharey=True)
    for axis, (title, part) in zip(axes, scopes.items(), strict=True):
        for place, method in enumerate(METHODS):
            found = error(part, method)
            axis.barh(place, found.value, 0.7, color=STYLES[method]["color"])
            if found.low is not None and found.high is not None:
                axis.plot([found.low, found.high], [place, place], color=INK, lw=1.6, marker="|")
        axis.set(title=title, xlabel="mean absolute error [training std]")
        axis.grid(axis="y", visible=False)
    axes[0].set_yticks(range(len(METHODS)), [HEADINGS[method] for method in METHODS])
    axes[0].invert_yaxis()
    figure.suptitle("Overall error on test ticks (left is better)")
    return figure


def dimensions(comparison: Comparison) -> Figure:
    """Mean absolute error of each dimension that varies, in units of its training deviation."""
    shown = comparison.varying()
    figure, axis = panels(9.0, 0.42 * len(shown) + 2.2)
    for method in METHODS:
        errors = comparison.in_training_std(comparison.scores[method].mae)
        axis.plot(errors, range(len(shown)), **_marked(method, ls=""))
    axis.set_yticks(range(len(shown)), _dimension_names(comparison))
    axis.set_ylim(len(shown) - 0.5, -0.5)
    axis.set_xlim(left=0)
    axis.set_xlabel("mean absolute error [training std] (left is better)")
    finish(figure, axis, 2, "Error of each action dimension on test ticks, over the whole chunk")
    return figure


def dimension_horizon(comparison: Comparison) -> Figure:
    """The policy's error over dimensions and steps ahead, each in its training deviation."""
    errors = comparison.in_training_std(comparison.scores["policy"].mae_horizon).T
    figure, axis = panels(9.0, 0.42 * len(errors) + 1.9)
    limits = (0, float(np.nanmax(errors)) or 1.0)
    image = draw_map(axis, errors, limits, "viridis_r", errors.shape[1] <= _NUMBERED_STEPS)
    figure.colorbar(image, ax=axis, pad=0.02, label="error [training std]")
    axis.set_yticks(range(len(errors)), _dimension_names(comparison))
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set_xlabel("steps ahead")
    figure.suptitle("Error of the policy by dimension and step of the chunk (light is better)")
    return figure


def horizon(comparison: Comparison, action_hz: float | None) -> Figure:
    """Mean absolute error by how far ahead an action lies, a panel an action group."""
    ahead = "steps ahead" if action_hz is None else f"steps ahead [{1000 / action_hz:.0f} ms each]"
    groups = comparison.varying_groups()
    figure, (axes,) = panels(max(4.6 * len(groups), 9.4), 4.4, 1, len(groups), squeeze=False)
    for axis, group in zip(axes, groups, strict=True):
        for method in METHODS:
            errors = group.mean(comparison.scores[method].mae_horizon)
            axis.plot(np.arange(len(errors)), errors, **_marked(method))
        for method in ("policy", best_baseline(comparison, group)):
            _draw_band(axis, comparison, method, group)
        axis.set(title=_group_title(comparison, group), xlabel=ahead)
        axis.set_ylabel(with_unit("mean absolute error", group.unit))
        axis.set_ylim(bottom=0)
        axis.xaxis.get_major_locator().set_params(integer=True)
    finish(figure, axes[0], 3, "Error over the action chunk (lower is better)")
    return figure


def _draw_band(axis: Axes, comparison: Comparison, method: str, group: ActionGroup) -> None:
    """The 95 % interval of a group's error at each step."""
    steps = range(comparison.cells.entries.shape[1])
    parts = (comparison.part(steps=slice(step, step + 1)) for step in steps)
    found = [error(part, method, group) for part in parts]
    low = [np.nan if figure.low is None else figure.low for figure in found]
    high = [np.nan if figure.high is None else figure.high for figure in found]
    axis.fill_between(steps, low, high, color=STYLES[method]["color"], alpha=0.18, lw=0)


def episodes(comparison: Comparison, store: FeatureStore) -> Figure:
    """Mean absolute error of each test episode, a panel an action group, worst on top."""
    order = np.array(comparison.ranked())
    title = "Error of each test episode, worst by overall error on top"
    if len(order) > EPISODE_LINES:
        order = order[np.linspace(0, len(order) - 1, EPISODE_LINES).round().astype(int)]
        title += f" ({len(order)} of {len(comparison.episodes)})"
    groups = comparison.varying_groups()
    size = max(3.6 * len(groups) + 3, 9.0), 0.3 * len(order) + 2
    figure, (axes,) = panels(*size, 1, len(groups), squeeze=False, sharey=True)
    lines = np.arange(len(order))
    for axis, group in zip(axes, groups, strict=True):
        for method in METHODS:
            errors = group.mean(comparison.scores[method].mae_episode)[order]
            axis.plot(errors, lines, **_marked(method, ls=""))
        label = with_unit("mean absolute error", group.unit)
        axis.set(title=_group_title(comparison, group), xlabel=label)
        axis.set_xlim(left=0)
    axes[0].set_yticks(lines, [_short_name(store.episodes[comparison.episodes[i]]) for i in order])
    axes[0].set_ylim(-0.6, len(order) - 0.4)
    finish(figure, axes[0], 3, f"{title} (left is better)")
    return figure


def scatter(comparison: Comparison, predictions: Predictions) -> Figure:
    """Predicted against recorded next action, a panel a dimension; on the diagonal it is right."""
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
        axis.plot([low, high], [low, high], color=INK, lw=1, zorder=1)
        axis.scatter(recorded, predicted, s=9, alpha=0.35, linewidths=0, color=_POLICY)
        axis.set(xlim=(low, high), ylim=(low, high), aspect="equal")
        axis.locator_params(nbins=4)
        axis.ticklabel_format(scilimits=(-2, 4), useOffset=False)
        name, unit = comparison.names[index], comparison.units[index]
        axis.set(xlabel=with_unit("recorded", unit), ylabel=with_unit("policy", unit))
        axis.set_title(with_unit(name, unit))
    figure.suptitle("Next action at test ticks: on the line, the policy does what was recorded")
    return figure


def timeline(comparison: Comparison, predictions: Predictions, store: FeatureStore) -> Figure:
    """Recorded and predicted action over time, a row a dimension, a column an episode."""
    shown = comparison.extremes()
    rows = len(comparison.names)
    size = max(5.8 * len(shown) + 0.4, 8.0), 1.15 * rows + 1.4
    figure, axes = panels(*size, rows, len(shown), squeeze=False, sharex="col", sharey="row")
    for column, (title, index) in enumerate(shown):
        time_s = _episode_time(store, store.episodes[index])
        for row, axis in enumerate(axes[:, column]):
            _plot_next_actions(axis, row, predictions, store.episodes[index], time_s)
        axes[0, column].set_title(f"{title}: {_short_name(store.episodes[index])}")
        axes[-1, column].set_xlabel("time since the episode began [s]")
    for row, axis in enumerate(axes[:, 0]):
        axis.set_ylabel(with_unit(comparison.names[row], comparison.units[row]))
        if comparison.scale[row] == 0:
            # Rounding noise of a channel that never varies must not fill its panel.
            low, high = axis.get_ylim()
            axis.set_ylim(min(low, high - 0.2), max(high, low + 0.2))
    figure.align_ylabels(axes[:, 0])
    finish(figure, axes[0, 0], 2, "Test episodes: the recorded action, and the policy's next")
    return figure


def chunks(
    comparison: Comparison,
    predictions: Predictions,
    store: FeatureStore,
    episode: Episode,
    instants: NDArray[np.int64],
    frames: Mapping[str, Sequence[NDArray[np.uint8]]],
) -> Figure:
    """Frames at `instants` above, and below them recorded and predicted actions over time.

    `instants` are test ticks of the episode, store-global; `frames` has one a view for each, or
    no view at all. Drawn are the next action at every tick, and the whole chunk at the instants.
    """
    time_s = _episode_time(store, episode)
    shown = comparison.varying()
    width = _CHUNKS_WIDTH / max(3, len(instants))
    shapes = [[image.shape for image in images] for images in frames.values()]
    heights = [width * max(shape[0] / shape[1] for shape in view) for view in shapes]
    heights += [1.15] * len(shown)
    figure = canvas(_CHUNKS_WIDTH, sum(heights) + 1.7)
    grid = figure.add_gridspec(len(heights), len(instants), height_ratios=heights)
    for row, (view, images) in enumerate(frames.items()):
        for column, image in enumerate(images):
            axis = figure.add_subplot(grid[row, column])
            draw_frame(axis, image)
            axis.set_ylabel("" if column else view)
            if row == 0:
                axis.set_title(f"{time_s[instants[column] - episode.ticks.start]:.1f} s")
    axes: list[Axes] = []
    places = np.flatnonzero(np.isin(predictions.ticks, instants))
    for row, dimension in enumerate(shown, len(frames)):
        axis = figure.add_subplot(grid[row, :], sharex=axes[0] if axes else None)
        axes.append(axis)
        _plot_next_actions(axis, dimension, predictions, episode, time_s)
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
    error = comparison.overall_by_episode("policy")[comparison.episodes.index(episode.index)]
    title = f"{_short_name(episode)}: overall error {error:.3f} [training std]"
    finish(figure, axes[0], 3, title)
    return figure


def _plot_next_actions(
    axis: Axes, dimension: int, predictions: Predictions, episode: Episode, time_s: NDArray[Any]
) -> None:
    """Recorded and predicted; `time_s` (tick,) counts from the episode's begin."""
    here = predictions.episodes == episode.index
    at = time_s[predictions.ticks[here] - episode.ticks.start]
    recorded, predicted = predictions.recorded[here, 0], predictions.predicted[here, 0]
    axis.plot(at, recorded[:, dimension], color=INK, lw=2.2, label="recorded")
    axis.plot(at, predicted[:, dimension], color=_POLICY, lw=1.6, label="policy, next action")


def curves(logged: TrainingCurves, step: int) -> Figure:
    """Loss, val error and learning rate over the steps; a line marks the step judged here."""
    shown = [name for name in _CURVES if name in logged.curves] or sorted(logged.curves)[:3]
    size = max(4.2 * len(shown), 8.4), 3.4
    figure, (axes,) = panels(*size, 1, len(shown), squeeze=False, sharex=True)
    for axis, name in zip(axes, shown, strict=True):
        curve, (title, colour) = logged.curves[name], _CURVES.get(name, (name, PALETTE[4]))
        marker = "o" if len(curve.step) <= 30 else ""
        axis.plot(curve.step, curve.value, color=colour, marker=marker, markersize=4)
        # Within a decade a logarithmic axis has nothing but odd numbers to show.
        if 0 < 10 * curve.value.min() <= curve.value.max():
            logarithmic(axis)
        else:
            axis.set_ylim(bottom=min(0.0, float(curve.value.min())))
        axis.set(title=title, xlabel="step")
        axis.axvline(step, color=INK, lw=1, ls="--")
    figure.suptitle(f"Course of the training; the checkpoint judged here is of step {step}")
    return figure


def modalities(study: AblationStudy) -> Figure:
    """The error with each stream ablated as a multiple of the intact one, a panel a stream.

    The error itself, in units of the training standard deviation, where the intact one is 0.
    """
    streams = [[one for one in study.ablated if one.stream == name] for name in study.streams]
    widths = [len(ways) for ways in streams]
    size, shared = (max(0.95 * sum(widths) + 1.5, 7.5), 4.6), {"sharey": True, "squeeze": False}
    figure, (axes,) = panels(*size, 1, len(widths), width_ratios=widths, **shared)
    unit, best = study.intact.overall("policy") or 1.0, best_baseline(study.intact)
    intact, blind = (study.intact.overall(method) / unit for method in ("policy", best))
    for axis, ways in zip(axes, streams, strict=True):
        heights = [ablated.comparison.overall("policy") / unit for ablated in ways]
        colours = [_ABLATIONS[ablated.how.split()[0]] for ablated in ways]
        bars = axis.bar(
            range(len(ways)), heights, color=colours, width=0.7, **_whiskers(study, ways)
        )
        # On a ground of its own, for a line may pass behind a number.
        ground = {"facecolor": GRID, "edgecolor": "none", "pad": 1}
        axis.bar_label(bars, fmt="%.2f", padding=3, bbox=ground)
        axis.axhline(intact, color=_POLICY, lw=1.8, label="policy, all streams intact")
        label = f"best {LABELS[best]}"
        axis.axhline(blind, color=INK, lw=1.8, ls="--", label=label)
        axis.set_xticks(range(len(ways)), [ablated.how.replace(" ", "\n", 1) for ablated in ways])
        axis.grid(axis="x", visible=False)
        axis.set_title(ways[0].stream)
    axes[0].set_ylabel("test error / error with all streams intact")
    axes[0].set_ylim(0, 1.12 * axes[0].get_ylim()[1])
    judged = f"{study.intact.ticks} test ticks, {study.samples} chunk(s) a tick"
    finish(figure, axes[0], 2, f"What the policy loses with one stream ablated\n{judged}")
    figure.legends[0].set_title(ABLATION_FOOTNOTE)
    return figure


def _whiskers(study: AblationStudy, ways: Sequence[Ablated]) -> dict[str, Any]:
    """Of the bars of these ways: how far their 95 % intervals reach below and above."""
    times = [study.times_intact(way) for way in ways]
    ends = [
        (figure.value - figure.low, figure.high - figure.value)
        for figure in times
        if figure is not None and figure.low is not None and figure.high is not None
    ]
    style = {"ecolor": INK, "error_kw": {"elinewidth": 1.4}}
    return {"yerr": np.transpose(ends), **style} if len(ends) == len(ways) else {}


def _marked(method: str, **changed: Any) -> dict[str, Any]:
    """How a way of acting is drawn where its points are marked."""
    return {"lw": 1.5, "ms": 5, "label": LABELS[method]} | STYLES[method] | changed


def _dimension_names(comparison: Comparison) -> list[str]:
    return [with_unit(comparison.names[i], comparison.units[i]) for i in comparison.varying()]


def _group_title(comparison: Comparison, group: ActionGroup) -> str:
    """The group and its dimensions, as the width of a panel allows."""
    names = [comparison.names[index] for index in group.dimensions]
    title = f"{group.name} ({', '.join(names)})"
    if len(title) <= _TITLE_WIDTH:
        return title
    ends = textwrap.fill(f"{names[0]} … {names[-1]}", _TITLE_WIDTH)
    return f"{group.name}, {len(names)} dimensions\n{ends}"


def _short_name(episode: Episode) -> str:
    """`episode_name`, its middle left out where it is too long for a title."""
    return shorten_middle(episode_name(episode), 14, 28)


def _episode_time(store: FeatureStore, episode: Episode) -> NDArray[np.float64]:
    """(tick,) s since the episode began."""
    time_s = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    return time_s - time_s[0]
