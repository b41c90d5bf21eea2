"""The pictures that say where in the model, and where in the image, the action is found."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from pipeline.plots.style import RECORDED, canvas, legend_below, write
from pipeline.probing import Finding, SlotName, Study, ranked

_BARS = 20
"""Choices that a picture still shows legibly."""
_ALONE, _BESIDE = "#56B4E9", "#0072B2"


def write_probe_plots(folder: Path, study: Study) -> list[Path]:
    """Write probe.png, the map over layers and poolings, and probe_bars.png, the ranking."""
    pictures = {"probe.png": lambda: heat_map(study), "probe_bars.png": lambda: bars(study)}
    return write(folder, pictures)


def heat_map(study: Study) -> Figure:
    """R^2 of every slot: layers against what is pooled over, and a small map of the cells a view.

    Beside state + sensor, where the store has them. Each map takes its colours from one scale.
    """
    plain = [one for one in study.slots if one.name.cell is None]
    poolings = list({one.name.pooling: None for one in study.groups})
    named = sorted([*study.groups, *plain], key=lambda one: poolings.index(one.name.pooling))
    kinds = {_column(one.name): None for one in named}
    rows = {_row(one.name): None for one in study.slots}
    maps = _maps(study)
    values = [_value(one) for one in (*study.slots, *study.groups)]
    low, high = _limits(values)
    columns = max([len(view) for view in maps.values()], default=0)
    height = 1.6 + 0.5 * len(rows) + 2.2 * len(maps)
    figure = canvas(max(7.5, 2.0 + 1.25 * len(kinds), 1.5 + 2.3 * columns), height)
    ratios = [0.6 + 0.5 * len(rows)] + [2.2] * len(maps)
    panels = figure.add_gridspec(1 + len(maps), max(1, columns), height_ratios=ratios)
    axes = [figure.add_subplot(panels[0, :])]
    image = _overview(axes[0], study, list(rows), list(kinds), (low, high))
    for place, (row, views) in enumerate(maps.items(), start=1):
        for column, (view, found) in enumerate(views.items()):
            axis = figure.add_subplot(panels[place, column])
            axes.append(axis)
            _cells(axis, found, f"{row}, {view}", (low, high))
    said = "beside state + sensor" if study.streams is not None else "alone"
    figure.colorbar(image, ax=axes, label=f"held-out R², {said}", shrink=min(1.0, 4 / height))
    figure.suptitle(_title(study, "Where a linear reader finds the action"))
    return figure


def bars(study: Study) -> Figure:
    """The choices of layer, norm and pooling, ranked, alone and beside state + sensor."""
    shown = [one for one in ranked(study.groups) if one.best is not None][:_BARS][::-1]
    figure = canvas(8.5, 2.4 + 0.55 * len(shown))
    axis = figure.subplots()
    at = np.arange(len(shown))
    kinds = [("alone", _ALONE, [one.alone for one in shown])]
    if study.streams is not None:
        kinds.append(("beside state + sensor", _BESIDE, [one.beside for one in shown]))
    for offset, (label, colour, scores) in enumerate(kinds):
        heights = [np.nan if one is None else one.mean for one in scores]
        errors = [np.nan if one is None else one.error for one in scores]
        where = at + (0.2 - 0.4 * offset if len(kinds) > 1 else 0)
        style = {"ecolor": RECORDED, "capsize": 3, "lw": 1}
        height = 0.38 if len(kinds) > 1 else 0.6
        axis.barh(where, heights, height, xerr=errors, color=colour, label=label, error_kw=style)
    if study.streams is not None:
        axis.axvline(
            study.streams.mean, color=RECORDED, ls="--", lw=1.8, label="state + sensor alone"
        )
    axis.axvline(0, color=RECORDED, lw=1)
    axis.set_yticks(at, [_bar_name(one) for one in shown])
    axis.grid(axis="y", visible=False)
    axis.set_xlabel("held-out R², mean over channels and steps (bars: standard error over folds)")
    legend_below(figure, axis, 3)
    figure.suptitle(_title(study, "What each choice of features says of the action"))
    return figure


def _overview(
    axis: Axes, study: Study, rows: Sequence[str], kinds: Sequence[str], limits: tuple[float, float]
) -> AxesImage:
    """Groups and whole views; a group of one slot is that slot."""
    grid = np.full((len(rows), len(kinds)), np.nan)
    plain = [one for one in study.slots if one.name.cell is None]
    for one in [*plain, *study.groups]:
        grid[rows.index(_row(one.name)), kinds.index(_column(one.name))] = _value(one)
    image = _map(axis, grid, limits)
    axis.set_xticks(range(len(kinds)), kinds)
    axis.set_yticks(range(len(rows)), rows)
    _number(axis, grid, image)
    return image


def _cells(axis: Axes, found: list[Finding], title: str, limits: tuple[float, float]) -> None:
    """Where in the image of a view: its cells, top left first."""
    places = [cell for one in found if (cell := one.name.cell) is not None]
    shape = (1 + max(row for row, _ in places), 1 + max(column for _, column in places))
    grid = np.full(shape, np.nan)
    for place, one in zip(places, found, strict=True):
        grid[place] = _value(one)
    image = _map(axis, grid, limits)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_title(title, fontsize=9)
    _number(axis, grid, image)


def _map(axis: Axes, grid: np.ndarray, limits: tuple[float, float]) -> AxesImage:
    colours = mpl.colormaps["viridis"].with_extremes(bad="#eeeeee")
    axis.grid(visible=False)
    return axis.imshow(grid, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto")


def _number(axis: Axes, grid: np.ndarray, image: AxesImage) -> None:
    for (row, column), value in np.ndenumerate(grid):
        if np.isfinite(value):
            low, high = image.get_clim()
            colour = "white" if value < low + 0.6 * (high - low) else "black"
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", color=colour, size=8)


def _maps(study: Study) -> dict[str, dict[str, list[Finding]]]:
    """The slots that are cells, by layer and by view."""
    found: dict[str, dict[str, list[Finding]]] = {}
    for one in study.slots:
        if one.name.cell is not None:
            views = found.setdefault(_row(one.name), {})
            views.setdefault(str(one.name.view), []).append(one)
    return found


def _limits(values: Sequence[float]) -> tuple[float, float]:
    """From what is found; a very bad slot does not wash out the others."""
    finite = [value for value in values if np.isfinite(value)] or [0.0]
    high = max(finite)
    low = max(min(finite), high - 1.0)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _value(one: Finding) -> float:
    return float("nan") if one.best is None else one.best.mean


def _row(name: SlotName) -> str:
    return f"layer {name.layer}{'' if name.norm else ', no norm'}"


def _column(name: SlotName) -> str:
    return name.pooling if name.view is None else f"{name.pooling}\n{name.view}"


def _bar_name(one: Finding) -> str:
    slots = f" ({len(one.slots)} slots)" if len(one.slots) > 1 else ""
    return f"{_row(one.name)}\n{one.name.pooling}{slots}"


def _title(study: Study, said: str) -> str:
    return (
        f"{said}\nchunks of {study.horizon} ticks at {len(study.folds.ticks)} ticks of "
        f"{study.folds.recordings} recordings, {study.folds.count} folds"
    )
