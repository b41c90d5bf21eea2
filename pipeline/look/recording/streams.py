"""Sensor, state and actions: pictures, statistics by channel, and what looks wrong in them."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.base.channels import PROFILE_CHANNELS, hardly_moving, named, unnumbered
from pipeline.base.config import Params
from pipeline.base.errors import Issue
from pipeline.base.text import Table
from pipeline.data import Channels, Stream
from pipeline.data.contact import CONTACT_RULE, contact_spans, force_columns
from pipeline.data.timeline import last_at
from pipeline.look.page.blocks import Block
from pipeline.look.page.style import PALETTE, panels, shorten_middle
from pipeline.look.recording.clocks import Clock, usual_step
from pipeline.look.recording.episode import Draw, LoadedRecording

# An outlier is so many times farther from its neighbours than 95 % of the entries are, and farther
# than all others are apart.
OUTLIER = 20.0
# Fewest entries for values to be judged.
_FEWEST = 20
_NEIGHBOURS = 5
# Channels worked on at a time: sorting copies them.
_SORTED = 16

CONTACT_COLOUR = "#E69F00"
_LINES = cycler(ls=("-", "--", ":")) * cycler(color=PALETTE)
# Most curves in a panel.
_TOGETHER = 9
# Fewest channels of a limb.
_LIMB = 3
# Characters of a name in a legend, at its beginning and at its end.
_BEGIN, _END = 13, 10
_WIDTH_IN, _PANEL_IN, _IMAGE_IN = 10.0, 1.75, 2.6
# A group whose channels move less than this share of its span is drawn as changes.
_STANDS_STILL = 0.2
# A curve of more readings is a bitmap in the page; an image has so many columns.
_BITMAP, _COLUMNS = 5000, 1200
# Least seconds that an image covers.
_LEAST_S = 1e-3


class ChannelGroup(NamedTuple):
    """Channels that share a panel: some of one unit, or one quantity over place.

    `profile` is the common name of the depths of an A-scan and the like, else ''.
    """

    profile: str
    unit: str
    indices: list[int]
    names: list[str]

    @property
    def label(self) -> str:
        """The common name, if any, and the unit, for an axis."""
        name = self.profile or (self.names[0] if len(self.names) == 1 else "")
        return f"{name} [{self.unit}]".strip() if self.unit else name


def group_channels(channels: Channels) -> list[ChannelGroup]:
    """The channels by unit, in their order; then profiles. Grippers are groups of their own.

    More than `_TOGETHER` of one unit are cut into groups: where the first word of the names changes
    from one limb to the next (left, right, …), and then evenly.
    """
    kinds = list(zip(map(unnumbered, channels.names), channels.units, strict=True))
    counts = Counter(kinds)
    groups: dict[tuple[str, str, bool], ChannelGroup] = {}
    for index, (name, (stem, unit)) in enumerate(zip(channels.names, kinds, strict=True)):
        profile = stem.replace("_#", "") if counts[stem, unit] >= PROFILE_CHANNELS else ""
        key = profile, unit, "gripper" in name.lower()
        group = groups.setdefault(key, ChannelGroup(profile, unit, [], []))
        group.indices.append(index)
        group.names.append(name)
    small = [part for group in groups.values() for part in _cut(group)]
    return sorted(small, key=lambda group: bool(group.profile))


def _cut(group: ChannelGroup) -> Iterator[ChannelGroup]:
    if group.profile or len(group.names) <= _TOGETHER:
        yield group
        return
    pairs = zip(group.indices, group.names, strict=True)
    limbs: list[list[tuple[int, str]]] = []
    for _, alike in groupby(pairs, lambda pair: re.split(r"[^a-zA-Z]", pair[1])[0]):
        limb = list(alike)
        if limbs and min(len(limbs[-1]), len(limb)) < _LIMB:
            limbs[-1] += limb
        else:
            limbs.append(limb)
    for limb in limbs:
        parts = -(-len(limb) // _TOGETHER)
        for at in np.array_split(np.arange(len(limb)), parts):
            indices, names = zip(*(limb[place] for place in at), strict=True)
            yield ChannelGroup("", group.unit, [*indices], [*names])


def named_groups(streams: Mapping[str, Stream]) -> list[tuple[str, ChannelGroup]]:
    """The groups of all these streams, each with its stream's name."""
    return [(name, group) for name in streams for group in group_channels(streams[name].channels)]


def sensor_blocks(view: LoadedRecording, draw: Draw, params: Params) -> list[Block]:
    """The picture of the sensor, contact marked; empty without one."""
    if view.sensor is None:
        return []
    spans = [f"{start - view.zero:.2f}–{stop - view.zero:.2f} s" for start, stop in contacts(view)]
    caption = f"Contact (shaded), by the force alone: {', '.join(spans) or 'none'}. {CONTACT_RULE}"
    return [draw("sensor", caption, draw_sensor)]


def motion_blocks(view: LoadedRecording, draw: Draw, params: Params) -> list[Block]:
    """The picture of state, poses and actions; empty without any."""
    if not {"state", "poses", "action"} & view.streams.keys():
        return []
    caption = "State of the robot as recorded, by unit, and the actions at the ticks."
    return [draw("motion", caption, draw_motion)]


def contacts(view: LoadedRecording) -> list[tuple[float, float]]:
    """Start and stop in s of each contact, by the force alone; none without a force."""
    sensor = view.sensor
    columns = [] if sensor is None else force_columns(sensor.channels.names)
    if sensor is None or not columns:
        return []
    newton = {sensor.channels.units[column] for column in columns} == {"N"}
    force = sensor.values[:, columns]
    return contact_spans(sensor.time, force, newton, usual_step(sensor.time))


def draw_sensor(view: LoadedRecording) -> Figure:
    """Curves of the sensor by unit above, a profile such as the A-scan as an image below.

    The spans in contact are shaded in all panels, over one axis of time.
    """
    assert view.sensor is not None
    groups = group_channels(view.sensor.channels)
    figure, axes = _panels(groups)
    spans = np.array(contacts(view)).reshape(-1, 2) - view.zero
    for axis, group in zip(axes, groups, strict=True):
        if group.profile:
            _draw_profile(axis, view.sensor, group, view.zero)
            # Only edges, which hide nothing of the image.
            for edge in spans.ravel():
                axis.axvline(edge, color=CONTACT_COLOUR, lw=1.4, ls="--")
            continue
        _draw_curves(axis, view.sensor, group, view.zero)
        for number, span in enumerate(spans):
            label = "" if number else "in contact"
            axis.axvspan(*span, color=CONTACT_COLOUR, alpha=0.22, lw=0, label=label)
        legend_beside(axis)
    return figure


def draw_motion(view: LoadedRecording) -> Figure:
    """State and poses in panels by unit, and below them the actions, held from tick to tick.

    If the channels of a panel are so far apart that no motion could be seen, the panel shows their
    change since the first reading, and the legend shows where each began.
    """
    shown = {name: stream for name, stream in view.shown.items() if name != "sensor"}
    drawn = named_groups(shown)
    figure, axes = _panels([group for _, group in drawn])
    actions = "actions as recorded" if view.timeline is None else "actions at the ticks"
    titled = ""
    for axis, (name, group) in zip(axes, drawn, strict=True):
        held = name == "action"
        _draw_curves(axis, shown[name], group, view.zero, held=held, changes=not held)
        axis.set_title("" if name == titled else actions if held else name, loc="left")
        legend_beside(axis)
        titled = name
    return figure


def plot_curves(
    axis: Axes,
    time: NDArray[np.float64],
    values: NDArray[np.floating],
    labels: Sequence[str],
    held: bool = False,
) -> None:
    """Draw values (point, channel) as a curve for each channel, the first 18 in different styles.

    `held` holds each value until the next. Long curves are a bitmap in the page.
    """
    axis.set_prop_cycle(_LINES)
    axis.plot(
        time,
        values,
        lw=1.3,
        # Matplotlib leaves labels that begin with an underscore out of the legend.
        label=[f" {label}" if label.startswith("_") else label for label in labels],
        drawstyle="steps-post" if held else "default",
        # A single reading makes no line.
        marker="." if len(time) == 1 else None,
        rasterized=len(time) > _BITMAP,
    )


def legend_beside(axis: Axes) -> None:
    """Draw the legend of a panel to its right, long names without their middles."""
    handles, names = axis.get_legend_handles_labels()
    labels = [shorten_middle(name, _BEGIN, _END) for name in names]
    place: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.005, 0.5)}
    axis.legend(handles, labels, fontsize=8, handlelength=1.6, labelspacing=0.3, **place)


def _panels(groups: Sequence[ChannelGroup]) -> tuple[Figure, list[Axes]]:
    heights = [_IMAGE_IN if group.profile else _PANEL_IN for group in groups]
    shape = {"squeeze": False, "sharex": True, "height_ratios": heights}
    figure, axes = panels(_WIDTH_IN, sum(heights) + 0.5, len(groups), **shape)
    axes[-1, 0].set_xlabel("time since the recording began [s]")
    return figure, list(axes[:, 0])


def _draw_curves(
    axis: Axes,
    stream: Stream,
    group: ChannelGroup,
    zero: float,
    held: bool = False,
    changes: bool = False,
) -> None:
    """Draw curves that break at gaps of the clock; with `changes`, channels that move little are
    drawn as changes.
    """
    values = stream.values[:, group.indices].astype(np.float64)
    labels, unit = group.names, group.label
    if changes and np.ptp(values, axis=0).max() < _STANDS_STILL * np.ptp(values):
        labels = [f"{name} from {at:.4g}" for name, at in zip(labels, values[0], strict=True)]
        values, unit = values - values[0], f"change {unit}".strip()
    breaks = np.flatnonzero(np.diff(stream.time) >= Clock("", "stream", stream.time).shortest_gap_s)
    time = np.insert(stream.time, breaks + 1, stream.time[breaks + 1])
    plot_curves(axis, time - zero, np.insert(values, breaks + 1, np.nan, axis=0), labels, held)
    axis.set_ylabel(unit)


def _draw_profile(axis: Axes, stream: Stream, group: ChannelGroup, zero: float) -> None:
    """Draw a line for each channel of the profile, the first on top.

    The colours ignore a few extremes. A column shows the last reading before it, and nothing at a
    gap of the clock.
    """
    clock = Clock("", "stream", stream.time)
    stop = max(stream.time[-1] + np.nan_to_num(clock.step_s), stream.time[0] + _LEAST_S)
    columns = np.linspace(stream.time[0], stop, _COLUMNS, endpoint=False)
    shown = last_at(stream.time, columns)
    image = stream.values[shown][:, group.indices].T
    image[:, columns - stream.time[shown] >= clock.shortest_gap_s] = np.nan
    low, high = np.nanpercentile(image, (1, 99.5))
    extent = (stream.time[0] - zero, stop - zero, len(image) - 0.5, -0.5)
    drawn = axis.imshow(image, vmin=low, vmax=high, aspect="auto", extent=extent)
    axis.grid(visible=False)
    axis.set_ylabel(f"depth: channel of {group.profile}")
    # Beside the panel, so that its time axis stays below that of the curves.
    bar = axis.inset_axes((1.01, 0.0, 0.015, 1.0))
    unit = f"[{group.unit}]" if group.unit else "(no unit)"
    axis.figure.colorbar(drawn, cax=bar, label=f"{group.profile} {unit}", extend="both")


def statistics_blocks(view: LoadedRecording, draw: Draw, params: Params) -> list[Block]:
    """A row for each channel, one row for all channels of a profile; empty without any stream.

    The row of a profile has the least and greatest value of all its channels; its other numbers are
    medians over them.
    """
    rows: list[tuple[object, ...]] = []
    streams = view.shown
    for name, group in named_groups(streams):
        values = streams[name].values
        statistics = describe_channels(values, group.indices)
        if group.profile:
            joint = np.median(statistics, axis=0)
            joint[0], joint[4] = statistics[:, 0].min(), statistics[:, 4].max()
            names = [f"{group.names[0]} … {group.names[-1]} ({len(group.names):,} channels)"]
            statistics = joint[None]
        else:
            names = group.names
        for channel, row in zip(names, statistics.tolist(), strict=True):
            rows.append((name, channel, group.unit, len(values), *row))
    heads = ("stream", "channel", "unit", "count")
    heads += ("min", "1 %", "median", "99 %", "max", "mean", "std")
    caption = "Of many channels in a row: the extremes of all, else the median over the channels."
    return [Table(heads, rows, caption)] if rows else []


def describe_channels(values: NDArray[np.floating], columns: Sequence[int]) -> NDArray[np.float64]:
    """(column, 7) of values (reading, channel): min, 1 %, median, 99 %, max, mean, std."""
    parts: list[NDArray[np.float64]] = []
    for first in range(0, len(columns), _SORTED):
        block = values[:, columns[first : first + _SORTED]].astype(np.float64)
        points = np.percentile(block, (0, 1, 50, 99, 100), axis=0)
        parts.append(np.concatenate([points, [block.mean(axis=0), block.std(axis=0)]]).T)
    return np.concatenate(parts)


def find_channel_issues(view: LoadedRecording) -> Iterator[Issue]:
    """Issues of kind flat channel, still channel, action and state outlier."""
    for name, stream in view.streams.items():
        if name != "poses" and len(stream.time) >= _FEWEST:
            yield from _unmoved(view, name, stream)
    if view.timeline is not None:
        yield from _outliers(view, "action", "tick", view.shown["action"])
    if view.state is not None:
        yield from _outliers(view, "state", "row", view.state)


def _unmoved(view: LoadedRecording, name: str, stream: Stream) -> Iterator[Issue]:
    """Channels that never change, and channels that hardly move compared with similar ones."""
    names, values = stream.channels.names, stream.values
    varies = np.ptp(values, axis=0) > 0
    # Many tasks never move the gripper.
    flat = [c for c in np.flatnonzero(~varies).tolist() if "gripper" not in names[c].lower()]
    if flat:
        message = f"{len(flat)} of {len(names)} channels never change: {named(names, flat)}"
        yield view.issue("flat channel", name, message)
    if name == "sensor":  # the depths of a scan are not equally bright
        return
    std = np.where(varies, values.std(axis=0, dtype=np.float64), 0)
    if usual := hardly_moving(std, names, stream.channels.units):
        largest = max(usual, key=lambda column: std[column] / usual[column])
        message = (
            f"{named(names, [*usual])} hardly move{'s' * (len(usual) == 1)}: a standard deviation "
            f"of {std[largest]:.2g} at most, where {usual[largest]:.2g} is usual for such channels"
        )
        yield view.issue("still channel", name, message)


def _outliers(view: LoadedRecording, name: str, entry: str, stream: Stream) -> Iterator[Issue]:
    """Single entries that jump away and back, unlike any other of the episode."""
    time, values = stream.time, stream.values.astype(np.float64)
    if len(time) < _FEWEST:
        return
    # Mirrored, so that the first and the last entry have neighbours.
    away = np.abs(values - median_filter(values, size=(_NEIGHBOURS, 1), mode="mirror"))
    usual = np.percentile(away, 95, axis=0)
    for column in np.flatnonzero(usual > 0).tolist():
        places = np.flatnonzero(away[:, column] > OUTLIER * usual[column])
        others = np.delete(values[:, column], places)
        places = places[away[places, column] > np.ptp(others)]
        if not len(places):
            continue
        worst = int(places[np.argmax(away[places, column])])
        unit = f" {stream.channels.units[column]}".rstrip()
        leap = f"{stream.channels.names[column]} leaps to {values[worst, column]:.4g}{unit}"
        rest = f"all others stay within {others.min():.4g} to {others.max():.4g}"
        message = f"{leap} ({entry} {worst}; {len(places)} such {entry}s); {rest}"
        stop = float(time[places[-1]]) + usual_step(time)
        yield view.issue(f"{name} outlier", name, message, float(time[places[0]]), stop)
