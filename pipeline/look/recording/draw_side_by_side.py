"""The picture of training samples: all that a policy sees at a tick, and what it should do."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pipeline.compat.batch import UnifiedBatch
from pipeline.compat.dataset import UnifiedVLADataset
from pipeline.data import Channels
from pipeline.look.page.style import canvas
from pipeline.look.recording.draw_channels import Group, groups, short_names
from pipeline.look.recording.draw_drawing import absent, centre, curves, legend_beside, words
from pipeline.look.recording.draw_masks import seen_views

_WIDTH_IN, _BESIDE_IN = 10.0, 1.6
"""Of the picture, as long as its columns are no narrower than the least; and what is beside them.

At a page's width its smallest text, 8 points, then is no smaller than 8 pixels.
"""
_LEAST_COLUMN_IN, _COLUMN_IN, _PANEL_IN = 1.65, 2.5, 1.15
_SMALL = 8
_CHARACTERS_AN_IN = 14
"""Of `_SMALL` text."""


@dataclass(frozen=True)
class _Row:
    """Panels of one group of channels, a sample each, or of one view."""

    kind: str
    """`view`, `sensor`, `state` or `action`."""
    name: str
    group: Group | None = None


def samples(dataset: UnifiedVLADataset, batch: UnifiedBatch, zero: float) -> Figure:
    """The samples of a batch side by side, a column each: frames, windows, action chunk.

    Windows end at their tick; hatched is what the episode had not recorded yet, or has not at all,
    and the steps of a chunk that lie past its end and are masked. States are drawn as what they
    changed since the first of the window. Features of a store have no frames to show. Times of the
    ticks count from `zero`, an instant of the recording's clock.
    """
    rows = _rows(dataset, batch)
    if not rows or not len(batch):
        return words("The batch has no sample.")
    column = (_WIDTH_IN - _BESIDE_IN) / len(batch)
    column = min(max(column, _LEAST_COLUMN_IN), _COLUMN_IN)
    heights = [_height(row, batch, column) for row in rows]
    figure = canvas(column * len(batch) + _BESIDE_IN, sum(heights) + 1.8)
    axes = figure.subplots(
        len(rows), len(batch), squeeze=False, gridspec_kw={"height_ratios": heights}
    )
    for place, (line, row) in enumerate(zip(axes, rows, strict=True)):
        last = place + 1 == len(rows) or rows[place + 1].kind != row.kind
        for index, axis in enumerate(line):
            _panel(axis, row, batch, index)
            _only_outer_labels(axis, row, index, last)
        if last and row.kind != "view":
            along = "steps ahead" if row.kind == "action" else "readings before the tick"
            line[(len(line) - 1) // 2].set_xlabel(along, fontsize=_SMALL)
        _together(line, row)
    _titles(figure, axes[0], dataset, batch, zero, int(_CHARACTERS_AN_IN * column))
    return figure


def _rows(dataset: UnifiedVLADataset, batch: UnifiedBatch) -> list[_Row]:
    rows = [_Row("view", view) for view in seen_views(batch.images or ())]
    for kind in ("sensor", "state", "action"):
        said = dataset.store.streams[kind]
        channels = Channels(tuple(said["names"]), tuple(said["units"]))
        found = sorted(groups(channels, by_name=False), key=lambda group: group.is_profile)
        rows += [_Row(kind, group.label, group) for group in found]
    return rows


def _height(row: _Row, batch: UnifiedBatch, column: float) -> float:
    if row.kind != "view":
        return _PANEL_IN
    frame = next(one[row.name] for one in batch.images or () if row.name in one)
    return column * frame.shape[0] / frame.shape[1]


def _panel(axis: Axes, row: _Row, batch: UnifiedBatch, index: int) -> None:
    if row.group is None:
        _frame(axis, batch, index, row.name)
    elif row.kind == "action":
        _chunk(axis, row.group, batch, index)
    else:
        _window(axis, row, batch, index)


def _frame(axis: Axes, batch: UnifiedBatch, index: int, view: str) -> None:
    axis.set(xticks=[], yticks=[])
    axis.grid(visible=False)
    frame = (batch.images or ())[index].get(view)
    if frame is None:
        centre(axis, "view missing")
        absent(axis, 0, 1)
    else:
        axis.imshow(frame)
        axis.spines[:].set_visible(False)


def _window(axis: Axes, row: _Row, batch: UnifiedBatch, index: int) -> None:
    assert row.group is not None
    values = getattr(batch, row.kind)[index].float().numpy()[:, list(row.group.indices)]
    valid = int(getattr(batch, f"{row.kind}_valid")[index])
    length = len(values)
    at = np.arange(length) - length + 1
    axis.set_xlim(at[0] - 0.5, at[-1] + 0.5)
    if valid < length:
        absent(axis, at[0] - 0.5, at[-1] + 0.5 - valid)
    if not valid:
        centre(axis, f"{row.kind} missing")
        return
    real, at = values[length - valid :], at[length - valid :]
    if row.group.is_profile:
        _image(axis, real, at)
    else:
        # States lie far apart and move little within a window.
        shown = real - real[0] if row.kind == "state" else real
        curves(axis, at.astype(np.float64), shown, short_names(row.group.names))


def _image(axis: Axes, real: NDArray[np.float32], at: NDArray[np.int64]) -> None:
    axis.imshow(
        real.T,
        cmap=mpl.colormaps["viridis"],
        aspect="auto",
        extent=(at[0] - 0.5, at[-1] + 0.5, real.shape[1] - 0.5, -0.5),
    )
    axis.set_xlim(axis.get_xlim()[0], at[-1] + 0.5)
    axis.grid(visible=False)


def _chunk(axis: Axes, group: Group, batch: UnifiedBatch, index: int) -> None:
    """Each action held for its step; those that are masked lie under a hatch."""
    values = batch.action[index].numpy()[:, list(group.indices)]
    valid = batch.action_valid[index].numpy()
    edges = np.arange(len(values) + 1, dtype=np.float64)
    held = np.concatenate([values, values[-1:]])
    curves(axis, edges, held, short_names(group.names), steps=True)
    for step in np.flatnonzero(~valid).tolist():
        absent(axis, step, step + 1)
    axis.set_xlim(0, len(values))


def _only_outer_labels(axis: Axes, row: _Row, index: int, last: bool) -> None:
    axis.tick_params(labelsize=_SMALL)
    if index == 0:
        axis.set_ylabel(row.name if row.kind == "view" else _quantity(row), fontsize=_SMALL)
    else:
        axis.tick_params(labelleft=False)
    if row.kind != "view":
        axis.xaxis.set_major_locator(MaxNLocator(3, integer=True))
        axis.tick_params(labelbottom=last)


def _quantity(row: _Row) -> str:
    if row.kind == "state":
        return f"{' '.join(filter(None, ['state', row.name]))},\nchange since the\nwindow began"
    depth = ", depth" if row.group is not None and row.group.is_profile else ""
    return f"{row.kind}\n{row.name}{depth}"


def _together(line: Sequence[Axes], row: _Row) -> None:
    """One range of values, and of colours, for all samples of a row."""
    if row.group is None:
        return
    if row.group.is_profile:
        images = [image for axis in line for image in axis.images]
        every = [np.asarray(image.get_array()).ravel() for image in images]
        limits = np.percentile(np.concatenate(every), (1, 99.5)) if every else (0, 1)
        for image in images:
            image.set_clim(*limits)
        for axis in line:
            axis.set_ylim(len(row.group.indices) - 0.5, -0.5)
        return
    drawn = [axis for axis in line if axis.lines]
    if not drawn:
        return
    lows, highs = zip(*(axis.get_ylim() for axis in drawn), strict=True)
    for axis in line:
        axis.set_ylim(min(lows), max(highs))
    if len(row.group.names) > 1:
        # The last sample's window is the fullest: a single reading has a marker in place of a line.
        legend_beside(line[-1], of=drawn[-1], fontsize=_SMALL)


def _titles(
    figure: Figure,
    axes: Sequence[Axes],
    dataset: UnifiedVLADataset,
    batch: UnifiedBatch,
    zero: float,
    room: int,
) -> None:
    """What tells a sample from the others above its column; above all what they have in common."""
    ids = [dataset.store.episodes[number].id for number in batch.episode.tolist()]
    places = list(zip(ids, batch.instruction, strict=True))
    alone = len(set(places)) == 1
    for index, axis in enumerate(axes):
        own = [] if alone else [_one_line(part, room) for part in _named(*places[index])]
        axis.set_title("\n".join([*own, _title(dataset, batch, index, zero)]), fontsize=_SMALL)
    common = _named(*places[0]) if alone else []
    common += [] if batch.images is not None else ["features of a store, no frames"]
    if common:
        wide = int(_CHARACTERS_AN_IN * (figure.get_figwidth() - 1))
        figure.suptitle("\n".join(_one_line(part, wide) for part in common), fontsize=9)


def _named(episode: str, instruction: str) -> list[str]:
    return [episode.split("/")[-1], f"“{instruction}”"]


def _one_line(said: str, room: int) -> str:
    return said if len(said) <= room else f"{said[: room - 1].rstrip()}…"


def _title(dataset: UnifiedVLADataset, batch: UnifiedBatch, index: int, zero: float) -> str:
    store = dataset.store
    episode = store.episodes[int(batch.episode[index])]
    tick = int(batch.tick[index]) - episode.ticks.start
    row = int(batch.vl_row[index]) - episode.vl_rows.start
    since = float(batch.time[index]) - zero
    age = 1000 * float(batch.feature_age[index])
    old = tick - row * store.vlm_reuse_count
    return (
        f"tick {tick} of {len(episode.ticks)}\nat {since:.2f} s\n"
        f"reuses VL row {row},\n{old} {'tick' if old == 1 else 'ticks'} old\n"
        f"newest frame {age:.0f} ms old"
    )
