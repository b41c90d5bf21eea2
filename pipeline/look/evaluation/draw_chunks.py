"""One episode closely: what the cameras saw, and the chunks that the policy made of it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from pipeline.evaluate.names import with_unit
from pipeline.look.evaluation.draw_predictions import short_name
from pipeline.look.page.style import INK, PALETTE, RECORDED, STYLES, canvas
from pipeline.store import Episode, FeatureStore
from pipeline.train.predictions import Predictions
from pipeline.train.scores import Comparison

_WIDTH = 11.0
_MADE = PALETTE[5]
"""Of the whole chunks."""


def chunks(
    comparison: Comparison,
    predictions: Predictions,
    store: FeatureStore,
    episode: Episode,
    instants: NDArray[np.int64],
    frames: Mapping[str, Sequence[NDArray[np.uint8]]],
) -> Figure:
    """Frames at `instants` above, and below them recorded and predicted actions over time.

    `instants` are held-out ticks of the episode, store-global; `frames` has one a view for each, or
    no view at all. Drawn are the next action at every tick, and the whole chunk at the instants.
    """
    first = episode.ticks.start
    time_s = store.array("tick/time")[first : episode.ticks.stop]
    time_s = time_s - time_s[0]
    dimensions = comparison.varying()
    tall = 1.15 * len(dimensions) + 1.2
    heights = [_WIDTH / max(3, len(instants)) * _tallness(images) for images in frames.values()]
    above_in = [sum(heights) + 0.5] if heights else []
    figure = canvas(_WIDTH, sum(above_in) + tall)
    parts = figure.subfigures(len(above_in) + 1, 1, height_ratios=[*above_in, tall], squeeze=False)
    below: SubFigure = parts[-1, 0]
    if heights:
        _frames(parts[0, 0], frames, time_s[instants - first])
    axes = below.subplots(len(dimensions), 1, squeeze=False, sharex=True)[:, 0]
    for axis, dimension in zip(axes, dimensions, strict=True):
        _course(axis, dimension, predictions, episode, time_s, instants)
        axis.set_ylabel(with_unit(comparison.names[dimension], comparison.units[dimension]))
    axes[-1].set_xlabel("time since the episode began [s]")
    below.align_ylabels(axes)
    handles, labels = axes[0].get_legend_handles_labels()
    below.legend(handles, labels, loc="outside lower center", ncols=3)
    error = comparison.overall_by_episode("policy")[comparison.episodes.index(episode.index)]
    figure.suptitle(f"{short_name(episode)}: overall error {error:.3f} [training std]")
    return figure


def _frames(
    figure: SubFigure, frames: Mapping[str, Sequence[NDArray[np.uint8]]], times: NDArray[Any]
) -> None:
    axes = figure.subplots(len(frames), len(times), squeeze=False)
    for row, (view, images) in zip(axes, frames.items(), strict=True):
        for axis, image in zip(row, images, strict=True):
            axis.imshow(image)
            axis.set(xticks=[], yticks=[])
            axis.grid(visible=False)
            axis.spines[:].set_visible(False)
        row[0].set_ylabel(view)
    for axis, time_s in zip(axes[0], times, strict=True):
        axis.set_title(f"{time_s:.1f} s")


def _course(
    axis: Axes,
    dimension: int,
    predictions: Predictions,
    episode: Episode,
    time_s: NDArray[np.float64],
    instants: NDArray[np.int64],
) -> None:
    here = np.flatnonzero(predictions.episodes == episode.index)
    ticks = predictions.ticks - episode.ticks.start
    at = time_s[ticks[here]]
    recorded = predictions.recorded[here, 0, dimension]
    axis.plot(at, recorded, color=RECORDED, lw=2.2, label="recorded")
    following = predictions.predicted[here, 0, dimension]
    policy = STYLES["policy"]["color"]
    axis.plot(at, following, color=policy, lw=1.6, label="policy, next action")
    for place in here[np.isin(predictions.ticks[here], instants)]:
        chunk = predictions.predicted[place, predictions.valid[place], dimension]
        ahead = time_s[ticks[place] :][: len(chunk)]
        axis.axvline(ahead[0], color=INK, lw=0.8, ls=":", zorder=1)
        axis.plot(ahead, chunk, color=_MADE, lw=2, zorder=6, label=_once(axis))
        axis.plot(ahead[:1], chunk[:1], color=_MADE, marker="o", ms=5, zorder=6)


def _once(axis: Axes) -> str:
    """The label of the chunks, for the first of them."""
    said = "policy, whole chunk at the dotted ticks"
    return "" if said in axis.get_legend_handles_labels()[1] else said


def _tallness(images: Sequence[NDArray[np.uint8]]) -> float:
    return max(image.shape[0] / image.shape[1] for image in images)
