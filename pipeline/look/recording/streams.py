"""Sensor, state and actions over time: their pictures, with contact marked."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from numpy.typing import NDArray

from pipeline.base.channels import PROFILE_CHANNELS, unnumbered
from pipeline.base.config import Params
from pipeline.data import Channels, Stream
from pipeline.data.contact import CONTACT_RULE, contact_spans, force_columns
from pipeline.data.timeline import last_at
from pipeline.look.page.blocks import Block
from pipeline.look.page.style import PALETTE, panels
from pipeline.look.recording.clocks import Clock, Span, usual_step
from pipeline.look.recording.episode import Draw, EpisodeView

CONTACT_COLOUR = "#E69F00"
_LINES = cycler(ls=("-", "--", ":")) * cycler(color=PALETTE)
_WIDTH_IN, _PANEL_IN, _IMAGE_IN = 10.0, 1.75, 2.6
# A group whose channels move less than this share of its span is drawn as changes.
_STANDS_STILL = 0.2
# Readings from which a curve is a bitmap in the page, and columns of an image.
_BITMAP, _COLUMNS = 5000, 1200
# Seconds that an image covers at least.
_LEAST_S = 1e-3


class Group(NamedTuple):
    """Channels that share a panel: those of one unit, or one quantity over place.

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


def group_channels(channels: Channels) -> list[Group]:
    """The channels by unit, in their order; then profiles. Grippers are groups of their own."""
    kinds = list(zip(map(unnumbered, channels.names), channels.units, strict=True))
    counts = Counter(kinds)
    groups: dict[tuple[str, str, bool], Group] = {}
    for index, (name, (stem, unit)) in enumerate(zip(channels.names, kinds, strict=True)):
        profile = stem.replace("_#", "") if counts[stem, unit] >= PROFILE_CHANNELS else ""
        key = profile, unit, "gripper" in name.lower()
        group = groups.setdefault(key, Group(profile, unit, [], []))
        group.indices.append(index)
        group.names.append(name)
    return sorted(groups.values(), key=lambda group: bool(group.profile))


def named_groups(streams: Mapping[str, Stream]) -> list[tuple[str, Group]]:
    """The groups of all these streams, each with its stream's name."""
    return [(name, group) for name in streams for group in group_channels(streams[name].channels)]


def sensor_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
    """The picture of the sensor, contact marked; empty without one."""
    if view.sensor is None:
        return []
    spans = [f"{start - view.zero:.2f}–{stop - view.zero:.2f} s" for start, stop in contacts(view)]
    caption = f"Contact (shaded), by the force alone: {', '.join(spans) or 'none'}. {CONTACT_RULE}"
    return [draw("sensor", caption, draw_sensor)]


def motion_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
    """The picture of state, poses and actions; empty without any."""
    if not {"state", "poses", "action"} & view.streams.keys():
        return []
    caption = "State of the robot as recorded, by unit, and the actions at the ticks."
    return [draw("motion", caption, draw_motion)]


def contacts(view: EpisodeView) -> tuple[Span, ...]:
    """Spans in which the needle touches something, by the force alone; none without a force."""
    sensor = view.sensor
    columns = [] if sensor is None else force_columns(sensor.channels.names)
    if sensor is None or not columns:
        return ()
    newton = {sensor.channels.units[column] for column in columns} == {"N"}
    step_s = usual_step(sensor.time)
    spans = contact_spans(sensor.time, sensor.values[:, columns], newton, step_s)
    return tuple(Span(*span) for span in spans)


def draw_sensor(view: EpisodeView) -> Figure:
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
            # Edges alone, which hide nothing of the image.
            for edge in spans.ravel():
                axis.axvline(edge, color=CONTACT_COLOUR, lw=1.4, ls="--")
            continue
        _draw_curves(axis, view.sensor, group, view.zero)
        for number, span in enumerate(spans):
            label = "" if number else "in contact"
            axis.axvspan(*span, color=CONTACT_COLOUR, alpha=0.22, lw=0, label=label)
        legend_beside(axis)
    return figure


def draw_motion(view: EpisodeView) -> Figure:
    """State and poses in panels by unit, and below them the actions, held from tick to tick.

    Where the channels of a panel lie so far apart that no motion would be seen, it shows their
    change since the first reading, and the legend where each began.
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
    """Draw values (point, channel) as a curve a channel, the first 18 in different styles.

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
    """The legend of a panel, right of it; in columns where it is long."""
    columns = 1 + len(axis.get_legend_handles_labels()[1]) // 8
    place: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.005, 0.5)}
    axis.legend(fontsize=8, ncols=columns, handlelength=1.6, **place)


def _panels(groups: Sequence[Group]) -> tuple[Figure, list[Axes]]:
    heights = [_IMAGE_IN if group.profile else _PANEL_IN for group in groups]
    shape = {"squeeze": False, "sharex": True, "height_ratios": heights}
    figure, axes = panels(_WIDTH_IN, sum(heights) + 0.5, len(groups), **shape)
    axes[-1, 0].set_xlabel("time since the recording began [s]")
    return figure, list(axes[:, 0])


def _draw_curves(
    axis: Axes, stream: Stream, group: Group, zero: float, held: bool = False, changes: bool = False
) -> None:
    """Curves that break at gaps of the clock; with `changes`, those that move little as changes."""
    values = stream.values[:, group.indices].astype(np.float64)
    labels, unit = group.names, group.label
    if changes and np.ptp(values, axis=0).max() < _STANDS_STILL * np.ptp(values):
        labels = [f"{name} from {at:.4g}" for name, at in zip(labels, values[0], strict=True)]
        values, unit = values - values[0], f"change {unit}".strip()
    breaks = np.flatnonzero(np.diff(stream.time) >= Clock("", "stream", stream.time).shortest_gap_s)
    time = np.insert(stream.time, breaks + 1, stream.time[breaks + 1])
    plot_curves(axis, time - zero, np.insert(values, breaks + 1, np.nan, axis=0), labels, held)
    axis.set_ylabel(unit)


def _draw_profile(axis: Axes, stream: Stream, group: Group, zero: float) -> None:
    """A channel of the profile a line, the first on top, in colours that ignore a few extremes.

    A column shows the last reading before it, and nothing at a gap of the clock.
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
