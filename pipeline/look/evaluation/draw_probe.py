"""The pictures that say where in the model, and where in the image, the action is found."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from pipeline.evaluate.probe.inputs import SlotName
from pipeline.evaluate.probe.study import ProbeResult, ProbeStudy, ranked
from pipeline.look.page.style import RECORDED, canvas, legend_below, write

_BARS = 20
"""Choices that a picture still shows legibly."""
_MAPS = 6
"""Maps of the cells of a view; most layers of a model look alike."""
_MAPS_A_ROW = 3
_LEAST = -0.2
"""Of the axis of scores: how much worse than the mean action makes no difference."""
_ALONE, _BESIDE = "#56B4E9", "#0072B2"


def write_probe_plots(folder: Path, study: ProbeStudy) -> list[Path]:
    """Write probe.png, the map over layers and poolings, and probe_bars.png, the ranking."""
    pictures = {"probe.png": lambda: heat_map(study), "probe_bars.png": lambda: bars(study)}
    return write(folder, pictures)


def heat_map(study: ProbeStudy) -> Figure:
    """R^2 of every slot: layers against what is pooled over, and the best maps of a view's cells.

    Beside state + sensor, where the store has them. All take their colours from one scale, which
    spans what is shown; what is more than 1 below its best has the darkest.
    """
    plain = [result for result in study.slots if result.name.cell is None]
    poolings = list({result.name.pooling: None for result in study.groups})
    named = sorted([*study.groups, *plain], key=lambda result: poolings.index(result.name.pooling))
    kinds = {_column(result.name): None for result in named}
    rows = {_row(result.name): None for result in study.slots}
    maps = _maps(study)
    shown = sorted(maps, key=lambda place: _best(maps[place]), reverse=True)[:_MAPS]
    lines = -(-len(shown) // _MAPS_A_ROW)
    seen = [*named, *(result for place in shown for result in maps[place])]
    values = [result.best.mean for result in seen]
    limits = _limits(values if study.streams is None else [*values, study.streams.mean])
    columns = max(1, min(_MAPS_A_ROW, len(shown)))
    height = 1.8 + 0.5 * len(rows) + 2.2 * lines
    figure = canvas(max(8.5, 2.0 + 1.25 * len(kinds), 1.5 + 2.3 * columns), height)
    ratios = [0.6 + 0.5 * len(rows)] + [2.2] * lines
    panels = figure.add_gridspec(1 + lines, columns, height_ratios=ratios)
    axes = [figure.add_subplot(panels[0, :])]
    image = _overview(axes[0], study, list(rows), list(kinds), limits)
    if study.streams is not None:
        axes[0].set_title(f"state + sensor alone: {study.streams.mean:.2f}", fontsize=9)
    for index, place in enumerate(shown):
        line, column = divmod(index, _MAPS_A_ROW)
        axis = figure.add_subplot(panels[1 + line, column])
        axes.append(axis)
        _cells(axis, maps[place], ", ".join(place), limits)
    _scale(figure, axes, image, study, min(values) < limits[0])
    words = "Where a linear reader finds the action"
    if len(shown) < len(maps):
        words += f" (the {len(shown)} best of {len(maps)} maps of a view; all are in slots.csv)"
    figure.suptitle(_title(study, words))
    return figure


def bars(study: ProbeStudy) -> Figure:
    """The choices of layer, norm and pooling, ranked, alone and beside state + sensor.

    A bar that would end left of the axis ends at an arrow and its number.
    """
    shown = ranked(study.groups)[:_BARS][::-1]
    figure = canvas(8.5, 2.4 + 0.55 * len(shown))
    axis = figure.subplots()
    at = np.arange(len(shown))
    kinds = [("alone", _ALONE, [result.alone for result in shown])]
    if study.streams is not None:
        kinds.append(("beside state + sensor", _BESIDE, [result.best for result in shown]))
    for offset, (label, colour, scores) in enumerate(kinds):
        heights = [score.mean for score in scores]
        errors = [score.error for score in scores]
        where = at + (0.2 - 0.4 * offset if len(kinds) > 1 else 0)
        style = {"ecolor": RECORDED, "capsize": 3, "lw": 1}
        height = 0.38 if len(kinds) > 1 else 0.6
        axis.barh(where, heights, height, xerr=errors, color=colour, label=label, error_kw=style)
        for place, value in zip(where, heights, strict=True):
            if value < _LEAST:
                _off_axis(axis, float(place), value)
    _state_sensor(axis, study)
    axis.axvline(0, color=RECORDED, lw=1)
    low, high = axis.get_xlim()
    axis.set_xlim(max(low, _LEAST), min(max(high, 0.1), 1.0))
    axis.set_yticks(at, [_bar_name(result) for result in shown])
    axis.grid(axis="y", visible=False)
    axis.set_xlabel("held-out R², mean over channels and steps (lines: standard error over folds)")
    legend_below(figure, axis, 3)
    figure.suptitle(_title(study, "What each choice of features says of the action"))
    return figure


def _state_sensor(axis: Axes, study: ProbeStudy) -> None:
    """Where state + sensor are by themselves, if only in the legend."""
    if study.streams is None:
        return
    mean = study.streams.mean
    label = "state + sensor alone"
    if mean < _LEAST:
        label += f" ({mean:.2f}, left of the axis)"
    axis.axvline(max(mean, _LEAST), color=RECORDED, ls="--", lw=1.8, label=label)


def _off_axis(axis: Axes, place: float, value: float) -> None:
    """On the bar, at the left end of the axis."""
    words = f"◀ {value:.2f}"
    axis.text(_LEAST + 0.005, place, words, ha="left", va="center", color="white", size=8)


def _overview(
    axis: Axes,
    study: ProbeStudy,
    rows: Sequence[str],
    kinds: Sequence[str],
    limits: tuple[float, float],
) -> AxesImage:
    """Groups and whole views; a group of one slot is that slot."""
    grid = np.full((len(rows), len(kinds)), np.nan)
    plain = [result for result in study.slots if result.name.cell is None]
    for result in [*plain, *study.groups]:
        grid[rows.index(_row(result.name)), kinds.index(_column(result.name))] = result.best.mean
    image = _map(axis, grid, limits)
    axis.set_xticks(range(len(kinds)), kinds)
    axis.set_yticks(range(len(rows)), rows)
    _number(axis, grid, image)
    return image


def _cells(axis: Axes, results: list[ProbeResult], title: str, limits: tuple[float, float]) -> None:
    """Where in the image of a view: its cells, top left first."""
    places = [cell for result in results if (cell := result.name.cell) is not None]
    shape = (1 + max(row for row, _ in places), 1 + max(column for _, column in places))
    grid = np.full(shape, np.nan)
    for place, result in zip(places, results, strict=True):
        grid[place] = result.best.mean
    image = _map(axis, grid, limits)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_title(title, fontsize=9)
    _number(axis, grid, image)


def _scale(
    figure: Figure, axes: Sequence[Axes], image: AxesImage, study: ProbeStudy, below: bool
) -> None:
    """The colours' numbers, and among them state + sensor by themselves."""
    known = study.streams
    words = "alone" if known is None else "beside state + sensor"
    if known is not None:
        words += f"\n(line: state + sensor alone, {known.mean:.2f})"
    bar = figure.colorbar(
        image, ax=axes, label=f"held-out R², {words}", extend="min" if below else "neither"
    )
    if known is not None:
        bar.ax.axhline(max(known.mean, image.get_clim()[0]), color="#D55E00", lw=2.5)


def _map(axis: Axes, grid: np.ndarray, limits: tuple[float, float]) -> AxesImage:
    colours = mpl.colormaps["viridis"].with_extremes(bad="none")
    axis.grid(visible=False)
    return axis.imshow(grid, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto")


def _number(axis: Axes, grid: np.ndarray, image: AxesImage) -> None:
    for (row, column), value in np.ndenumerate(grid):
        if np.isfinite(value):
            low, high = image.get_clim()
            colour = "white" if value < low + 0.6 * (high - low) else "black"
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", color=colour, size=8)


def _maps(study: ProbeStudy) -> dict[tuple[str, str], list[ProbeResult]]:
    """The slots that are cells, by layer and view."""
    maps: dict[tuple[str, str], list[ProbeResult]] = {}
    for result in study.slots:
        if result.name.cell is not None:
            maps.setdefault((_row(result.name), str(result.name.view)), []).append(result)
    return maps


def _best(cells: Sequence[ProbeResult]) -> float:
    return max(result.best.mean for result in cells)


def _limits(values: Sequence[float]) -> tuple[float, float]:
    """From what is there; a very bad slot does not wash out the others."""
    high = max(values)
    low = max(min(values), high - 1.0)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _row(name: SlotName) -> str:
    return f"layer {name.layer}{'' if name.norm else ', no norm'}"


def _column(name: SlotName) -> str:
    return name.pooling if name.view is None else f"{name.pooling}\n{name.view}"


def _bar_name(result: ProbeResult) -> str:
    slots = f" ({len(result.slots)} slots)" if len(result.slots) > 1 else ""
    return f"{_row(result.name)}\n{result.name.pooling}{slots}"


def _title(study: ProbeStudy, words: str) -> str:
    return (
        f"{words}\nchunks of {study.horizon} ticks at {len(study.folds.ticks)} ticks of "
        f"{study.folds.recordings} recordings, {study.folds.count} folds"
    )
