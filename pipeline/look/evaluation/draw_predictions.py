"""The pictures of an evaluation: what a policy did beside what was recorded."""

import math
import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.evaluate.names import with_unit
from pipeline.look.page.style import LABELS, RECORDED, STYLES, canvas, legend_below
from pipeline.store import Episode, FeatureStore, episode_name
from pipeline.train.predictions import METHODS, Predictions
from pipeline.train.scores import ActionGroup, Comparison

SCATTER_POINTS = 4000
EPISODE_LINES = 40
_TITLE_WIDTH = 34
"""Characters for which a panel of an action group has room."""


def timeline(comparison: Comparison, predictions: Predictions, store: FeatureStore) -> Figure:
    """Recorded and predicted action over time, a row a dimension, a column an episode."""
    shown = comparison.extremes()
    rows = len(comparison.names)
    figure = canvas(max(5.8 * len(shown) + 0.4, 8.0), 1.15 * rows + 1.4)
    axes = figure.subplots(rows, len(shown), squeeze=False, sharex="col", sharey="row")
    for column, (title, index) in enumerate(shown):
        episode = store.episodes[index]
        here = predictions.episodes == index
        time_s = store.array("tick/time")[predictions.ticks[here]]
        time_s = time_s - store.array("tick/time")[episode.ticks.start]
        for row, axis in enumerate(axes[:, column]):
            axis.plot(
                time_s, predictions.recorded[here, 0, row], color=RECORDED, lw=2.2, label="recorded"
            )
            axis.plot(
                time_s,
                predictions.predicted[here, 0, row],
                color=STYLES["policy"]["color"],
                lw=1.6,
                label="policy, next action",
            )
        axes[0, column].set_title(f"{title}: {short_name(episode)}")
        axes[-1, column].set_xlabel("time since the episode began [s]")
    for row, axis in enumerate(axes[:, 0]):
        axis.set_ylabel(with_unit(comparison.names[row], comparison.units[row]))
        _readable_range(axis, comparison.scale[row])
    figure.align_ylabels(axes[:, 0])
    legend_below(figure, axes[0, 0], 2)
    figure.suptitle("Held-out episodes: the recorded action, and what the policy would do next")
    return figure


def scatter(comparison: Comparison, predictions: Predictions) -> Figure:
    """Predicted against recorded next action, a panel a dimension; on the diagonal it is right."""
    dimensions = comparison.varying()
    count = len(dimensions)
    columns = min(4, count)
    lines = math.ceil(count / columns)
    figure = canvas(3.1 * columns, 3.1 * lines + 0.5)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    step = math.ceil(len(predictions.ticks) / SCATTER_POINTS)
    for axis in axes[count:]:
        axis.set_axis_off()
    for index, axis in zip(dimensions, axes, strict=False):
        recorded = predictions.recorded[::step, 0, index]
        predicted = predictions.predicted[::step, 0, index]
        low, high = _padded(np.concatenate([recorded, predicted]))
        axis.plot([low, high], [low, high], color=RECORDED, lw=1, zorder=1)
        axis.scatter(
            recorded, predicted, s=9, alpha=0.35, linewidths=0, color=STYLES["policy"]["color"]
        )
        axis.set(xlim=(low, high), ylim=(low, high), aspect="equal")
        axis.locator_params(nbins=4)
        axis.ticklabel_format(scilimits=(-2, 4), useOffset=False)
        unit = comparison.units[index]
        axis.set_title(with_unit(comparison.names[index], unit))
        axis.set_xlabel(with_unit("recorded", unit))
        axis.set_ylabel(with_unit("policy", unit))
    figure.suptitle("Next action at held-out ticks: on the line, the policy does what was recorded")
    return figure


def horizon(comparison: Comparison, action_hz: float | None) -> Figure:
    """Mean absolute error by how far ahead an action lies, a panel an action group."""
    groups = comparison.varying_groups()
    figure = canvas(max(4.6 * len(groups), 9.4), 4.4)
    axes = figure.subplots(1, len(groups), squeeze=False)[0]
    for axis, group in zip(axes, groups, strict=True):
        for method in METHODS:
            errors = group.mean(comparison.scores[method].mae_horizon)
            axis.plot(np.arange(len(errors)), errors, label=LABELS[method], **marked(method))
        axis.set_title(_title(comparison, group))
        axis.set_xlabel(
            "steps ahead" if action_hz is None else f"steps ahead [{1000 / action_hz:.0f} ms each]"
        )
        axis.set_ylabel(with_unit("mean absolute error", group.unit))
        axis.set_ylim(bottom=0)
        axis.xaxis.get_major_locator().set_params(integer=True)
    legend_below(figure, axes[0], len(METHODS))
    figure.suptitle("Error over the action chunk on held-out ticks (lower is better)")
    return figure


def episodes(comparison: Comparison, store: FeatureStore) -> Figure:
    """Mean absolute error of each held-out episode, a panel an action group, worst on top."""
    order = np.array(comparison.ranked())
    if len(order) > EPISODE_LINES:
        order = order[np.linspace(0, len(order) - 1, EPISODE_LINES).round().astype(int)]
    groups = comparison.varying_groups()
    figure = canvas(max(3.6 * len(groups) + 3, 9.0), 0.3 * len(order) + 2)
    axes = figure.subplots(1, len(groups), squeeze=False, sharey=True)[0]
    lines = np.arange(len(order))
    for axis, group in zip(axes, groups, strict=True):
        for method in METHODS:
            errors = group.mean(comparison.scores[method].mae_episode)[order]
            axis.plot(errors, lines, label=LABELS[method], **marked(method) | {"linestyle": ""})
        axis.set_title(_title(comparison, group))
        axis.set_xlabel(with_unit("mean absolute error", group.unit))
        axis.set_xlim(left=0)
    axes[0].set_yticks(lines, [short_name(store.episodes[comparison.episodes[i]]) for i in order])
    axes[0].set_ylim(-0.6, len(order) - 0.4)
    legend_below(figure, axes[0], len(METHODS))
    some = (
        f" ({len(order)} of {len(comparison.episodes)})"
        if len(order) < len(comparison.episodes)
        else ""
    )
    figure.suptitle(
        f"Error of each held-out episode{some}, worst by overall error on top (left is better)"
    )
    return figure


def short_name(episode: Episode) -> str:
    """`episode_name`, its middle left out where it is too long for a title."""
    name = episode_name(episode)
    return name if len(name) <= 44 else f"{name[:14]}…{name[-28:]}"


def marked(method: str) -> dict[str, Any]:
    """How a way of acting is drawn where its points are marked."""
    wide = method == "policy"
    # An open, larger square stays visible where the mean action is next to no motion.
    size = {"policy": 6.5, "zero_action": 8.5}.get(method, 5)
    return STYLES[method] | {"linewidth": 2.4 if wide else 1.5, "markersize": size}


def _title(comparison: Comparison, group: ActionGroup) -> str:
    """The group and its dimensions, as the width of a panel allows."""
    names = [comparison.names[index] for index in group.dimensions]
    title = f"{group.name} ({', '.join(names)})"
    if len(title) <= _TITLE_WIDTH:
        return title
    ends = textwrap.fill(f"{names[0]} … {names[-1]}", _TITLE_WIDTH)
    return f"{group.name}, {len(names)} dimensions\n{ends}"


def _readable_range(axis: Axes, scale: float) -> None:
    """Keep a channel that never varies from filling its panel with rounding noise."""
    if scale == 0:
        low, high = axis.get_ylim()
        middle = (low + high) / 2
        half = max((high - low) / 2, 0.1 * max(1.0, abs(middle)))
        axis.set_ylim(middle - half, middle + half)


def _padded(values: NDArray[np.floating]) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = max(0.05 * (high - low), 0.02 * max(abs(low), abs(high)), 1e-6)
    return low - margin, high + margin
