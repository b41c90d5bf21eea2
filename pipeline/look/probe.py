"""The page of a probe: which layers and which cells of the image predict the action."""

from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from pipeline.evaluate.probe.inputs import SlotName
from pipeline.evaluate.probe.study import ProbeResult, ProbeStudy, recommend
from pipeline.evaluate.probe.tables import advice, codec_table, notes, ranking
from pipeline.look.page.blocks import Picture, Report, Section, Text, next_steps
from pipeline.look.page.style import canvas
from pipeline.vlm.slots import layer_name

_MAPS = 6
"""The most maps of the cells of a view; the layers of a model look alike."""
_MAPS_A_ROW = 3


def probe_report(study: ProbeStudy, store: str) -> Report:
    """The page of a probe of the store of this name."""
    advised = recommend(study)
    caption = "What each slot adds to what is known without features."
    return Report(
        title=f"Probe of {store}",
        verdict=(
            "No choice of features helps a linear reader here"
            if advised is None
            else f"Keep {advised.chosen.name.label}"
        ),
        summary=(
            f"R² of the action chunk of {study.horizon} ticks on held-out recordings: 1 is exact, "
            "0 no better than their mean."
        ),
        sections=(
            Section(
                "What predicts the action",
                [Picture("probe", caption, partial(draw_gains, study)), ranking(study)]
                + [Text(note) for note in notes(study)],
            ),
            *(
                [
                    Section(
                        "What fewer bytes would lose",
                        [
                            codec_table(study),
                            Text(
                                "R2 of the features alone, less that of what is stored, with its "
                                "95 % interval: where it holds 0, no loss is resolved. The error "
                                "is the root mean square change of a number, in standard "
                                "deviations of its channel."
                            ),
                        ],
                    )
                ]
                if study.codecs
                else []
            ),
            next_steps(
                *advice(study).splitlines(),
                "Train on that choice and on all of it, and roll both out: a probe is linear."
                * (advised is not None),
            ),
        ),
    )


def draw_gains(study: ProbeStudy) -> Figure:
    """The gain of every slot over the baseline without features.

    The upper part shows layers by pooling, the lower part the best maps of a view's cells. All
    share one colour scale, from at most 1 below the best shown value up to this value.
    """
    plain = [result for result in study.slots if result.name.cell is None]
    poolings = list({result.name.pooling: None for result in study.groups})
    named = sorted([*study.groups, *plain], key=lambda result: poolings.index(result.name.pooling))
    rows = list(dict.fromkeys(_row(result.name) for result in (*study.groups, *study.slots)))
    maps: dict[str, list[ProbeResult]] = defaultdict(list)
    for result in study.slots:
        if result.name.cell is not None:
            of_grid = "" if result.name.pooling == "grid" else f", {result.name.pooling}"
            maps[f"{_row(result.name)}{of_grid}, {result.name.view}"].append(result)
    gains = {result: study.gain(result).value for result in (*study.groups, *study.slots)}
    best = {title: max(gains[result] for result in cells) for title, cells in maps.items()}
    shown = sorted(maps, key=best.__getitem__, reverse=True)[:_MAPS]
    seen = [*named, *(result for title in shown for result in maps[title])]
    values = [gains[result] for result in seen]
    limits = _limits([*values, 0.0])

    columns, lines = max(1, min(_MAPS_A_ROW, len(shown))), -(-len(shown) // _MAPS_A_ROW)
    kinds = list(dict.fromkeys(_column(result.name) for result in named))
    width = max(8.5, 2.0 + 1.25 * len(kinds), 1.5 + 2.3 * columns)
    figure = canvas(width, 1.8 + 0.5 * len(rows) + 2.2 * lines)
    ratios = [0.6 + 0.5 * len(rows)] + [2.2] * lines
    places = figure.add_gridspec(1 + lines, columns, height_ratios=ratios)
    overview = figure.add_subplot(places[0, :])
    # A group of one slot is that slot.
    cells = [(rows.index(_row(r.name)), kinds.index(_column(r.name))) for r in named]
    image = _draw_map(overview, _grid(cells, [gains[r] for r in named]), limits)
    overview.set_xticks(range(len(kinds)), kinds)
    overview.set_yticks(range(len(rows)), rows)
    for index, title in enumerate(shown):
        axis = figure.add_subplot(places[1 + index // _MAPS_A_ROW, index % _MAPS_A_ROW])
        cells = [result.name.cell or (0, 0) for result in maps[title]]
        _draw_map(axis, _grid(cells, [gains[result] for result in maps[title]]), limits)
        axis.set(xticks=[], yticks=[])
        axis.set_title(title, fontsize=9)

    extend = "min" if min(values) < limits[0] else "neither"
    known = f"{study.baseline.name} ({study.baseline.score.mean:.2f})"
    label = f"gain in held-out R² over\n{known}"
    bar = figure.colorbar(image, ax=figure.axes, label=label, extend=extend)
    bar.ax.axhline(max(0.0, limits[0]), color="#D55E00", lw=2.5)
    words = "Where a linear reader finds the action"
    if len(shown) < len(maps):
        words += f" (the {len(shown)} best of {len(maps)} maps of a view; all are in slots.csv)"
    figure.suptitle(
        f"{words}\nchunks of {study.horizon} ticks at {len(study.folds.ticks)} ticks of "
        f"{study.folds.recordings} recordings, {study.folds.count} folds dealt "
        f"{len(study.folds.deals)} times"
    )
    return figure


def _draw_map(axis: Axes, grid: NDArray[Any], limits: tuple[float, float]) -> AxesImage:
    """The (row, column) values as coloured cells with their numbers; NaN is empty."""
    low, high = limits
    axis.grid(visible=False)
    image = axis.imshow(grid, vmin=low, vmax=high, aspect="auto", interpolation="nearest")
    decimals = 2 if high - low >= 0.1 else 3
    for (row, column), value in np.ndenumerate(grid):
        if np.isfinite(value):
            light = np.dot(image.to_rgba(value)[:3], (0.3, 0.6, 0.1)) > 0.5
            ink = "#111111" if light else "#ffffff"
            words = f"{value:z.{decimals}f}"
            axis.text(column, row, words, ha="center", va="center", color=ink, size=8)
    return image


def _grid(places: Sequence[tuple[int, int]], values: Sequence[float]) -> NDArray[np.float64]:
    """Values at their (row, column); NaN where there is none."""
    grid = np.full(np.max(places, axis=0) + 1, np.nan)
    for place, value in zip(places, values, strict=True):
        grid[place] = value
    return grid


def _limits(values: Sequence[float]) -> tuple[float, float]:
    """The range of the values, at most 1, so that a very bad slot does not wash out the others."""
    high = max(values)
    low = max(min(values), high - 1.0)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _row(name: SlotName) -> str:
    return layer_name(name.layer, name.norm)


def _column(name: SlotName) -> str:
    return name.pooling if name.view is None else f"{name.pooling}\n{name.view}"
