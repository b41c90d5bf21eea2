"""The picture of a batch: what of it is real."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pipeline.compat.batch import UnifiedBatch
from pipeline.look.page.style import PALETTE, canvas
from pipeline.look.recording.draw_drawing import say
from pipeline.look.recording.runs import runs

REAL, PADDED, MASKED, MISSING = range(4)
_MEANINGS = (
    "real",
    "left padding: zeros, before the episode began",
    "masked: past the episode's end, no loss",
    "missing: the episode has no such stream or view",
)
COLOURS = (PALETTE[0], "#999999", PALETTE[1], PALETTE[3])
_LABELLED = 16
"""Samples whose number and count still have room beside the map."""


def batch(batch: UnifiedBatch) -> Figure:
    """A map a stream, a line a sample, a column a position: real, padded, masked or missing."""
    views = seen_views(batch.images or ())
    maps = [
        ("sensor window", "readings before the tick", _window(batch, "sensor")),
        ("state window", "readings before the tick", _window(batch, "state")),
        ("action chunk", "steps ahead", _chunk(batch)),
        _seen(batch, views),
    ]
    height = min(max(0.24 * len(batch), 1.1), 6.0)
    figure = canvas(10.0, 2 * height + 2.3)
    axes = figure.subplots(2, 2).ravel()
    for axis, (title, along, kinds) in zip(axes, maps, strict=True):
        axis.set_title(title, loc="left", fontsize=10)
        if kinds.size:
            _map(axis, kinds, along)
        else:
            say(axis, "not in this data set")
    if views:
        axes[-1].set_xticks(range(len(views)), views)
    handles = [Patch(color=ink, label=said) for ink, said in zip(COLOURS, _MEANINGS, strict=True)]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _window(batch: UnifiedBatch, stream: str) -> NDArray[np.int64]:
    """(sample, position) what each reading of a window is."""
    length, width = getattr(batch, stream).shape[1:]
    if not width:
        return np.zeros((len(batch), 0), np.int64)
    valid = getattr(batch, f"{stream}_valid").numpy()[:, None]
    kinds = np.where(np.arange(length) >= length - valid, REAL, PADDED)
    return np.where(valid == 0, MISSING, kinds)


def _chunk(batch: UnifiedBatch) -> NDArray[np.int64]:
    return np.where(batch.action_valid.numpy(), REAL, MASKED)


def seen_views(images: Sequence[Mapping[str, object]]) -> list[str]:
    """Those that any sample has, in the order of their names."""
    return sorted({view for one in images for view in one})


def _seen(batch: UnifiedBatch, views: Sequence[str]) -> tuple[str, str, NDArray[np.int64]]:
    """Slots of features, or the views where there are frames."""
    if batch.images is None:
        return "features", "slot", np.where(batch.slot_valid.numpy(), REAL, MISSING)
    there = [[REAL if view in one else MISSING for view in views] for one in batch.images]
    return "frames", "view", np.array(there, np.int64).reshape(len(batch), len(views))


def _map(axis: Axes, kinds: NDArray[np.int64], along: str) -> None:
    count, length = kinds.shape
    from_tick = along.endswith("before the tick")
    left = 0.5 - length if from_tick else -0.5
    thick = 0.9 if count <= _LABELLED else 1.0
    for line, row in enumerate(kinds):
        for kind in np.unique(row).tolist():
            # Not an image: its colours would stay as they are where those of the legend follow
            # the page's light or dark.
            spans = [(left + start, stop - start) for start, stop in runs(row == kind)]
            axis.broken_barh(spans, (line - thick / 2, thick), color=COLOURS[kind], lw=0)
    axis.set(xlim=(left, left + length), ylim=(count - 0.5, -0.5))
    axis.grid(visible=False)
    axis.set_xlabel(along)
    axis.set_ylabel("sample")
    for one in (axis.xaxis, axis.yaxis):
        one.set_major_locator(MaxNLocator(integer=True))
    if count <= _LABELLED:
        _counts(axis, (kinds == REAL).sum(axis=1).tolist(), length)


def _counts(axis: Axes, real: Sequence[int], length: int) -> None:
    for line, found in enumerate(real):
        axis.annotate(
            f"{found} of {length}",
            (1.01, line),
            xycoords=axis.get_yaxis_transform(),
            va="center",
            size=8,
        )
