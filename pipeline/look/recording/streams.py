"""What was felt and how the robot moved: contact, and the pictures of sensor, state and actions.

The rule of contact, by the force alone: at the start the needle is clear, so the median force of
the first `_REST_S` is rest; the noise is what the force does from reading to reading and within
that time. The force, smoothed by a running median, is in contact from where it leaves rest by
`_ENTER` times its noise until it is back within `_LEAVE` times: hysteresis, as in O. H. Schmitt,
"A thermionic trigger", Journal of Scientific Instruments 15(1), 1938. A force in newtons has to
leave rest by `_LEAST_N` at least.

Its limits: a recording that begins in contact shows only what presses harder or less; a sensor that
drifts by more than the threshold makes a contact seem to begin early, or to last when the needle
has glided out of tissue; a touch below the threshold is none.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import median_abs_deviation

from pipeline.base.channels import PROFILE_CHANNELS, unnumbered
from pipeline.base.config import Params
from pipeline.data import Channels, Stream
from pipeline.data.timeline import last_at
from pipeline.look.page.blocks import Block
from pipeline.look.page.style import PALETTE, panels
from pipeline.look.recording.clocks import Clock, Span, usual_step
from pipeline.look.recording.episode import Draw, EpisodeView, runs

CONTACT_COLOUR = "#E69F00"
_LINES = cycler(ls=("-", "--", ":")) * cycler(color=PALETTE)
_WIDTH_IN, _PANEL_IN, _SMALL_IN, _IMAGE_IN = 10.0, 1.75, 1.0, 2.6
# Of the span of a group: where its channels move less than this, their changes are drawn.
_STANDS_STILL = 0.2
# Readings from which a curve is a bitmap in the page, and columns of an image.
_BITMAP, _COLUMNS = 5000, 1200
# Seconds that an image covers at least.
_LEAST_S = 1e-3


_REST_S = 0.5
_SMOOTHED_S = 0.02
_ENTER, _LEAVE = 6.0, 3.0
_LEAST_N = 0.05
# Contacts nearer than this are one; shorter ones are none.
_APART_S, _SHORTEST_S = 0.1, 0.05

# The rule in a sentence, for a caption.
RULE = (
    f"It begins where the force leaves its median of the first {_REST_S:g} s by {_ENTER:g} times "
    f"its noise, and ends where it is back within {100 * _LEAVE / _ENTER:.0f} % of that."
)
# A standard deviation, of normal noise, that outliers do not raise.
_spread = partial(median_abs_deviation, axis=0, scale=1 / 1.4826)


class Group(NamedTuple):
    """Channels that one panel shows: those of one unit, or one quantity over place.

    `profile` is what the names of the depths of an A-scan and the like have in common, else ''.
    """

    profile: str
    unit: str
    indices: list[int]
    names: list[str]

    @property
    def label(self) -> str:
        """Name, where there is one for all, and unit as an axis says them."""
        name = self.profile or (self.names[0] if len(self.names) == 1 else "")
        return f"{name} [{self.unit}]".strip() if self.unit else name


def group_channels(channels: Channels) -> list[Group]:
    """The channels by unit, in the order in which they come; then profiles; grippers are apart."""
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
    caption = f"Contact (shaded), by the force alone: {', '.join(spans) or 'none'}. {RULE}"
    return [draw("sensor", caption, draw_sensor)]


def motion_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
    """The picture of state, poses and actions; empty without any."""
    if not {"state", "poses", "action"} & view.streams.keys():
        return []
    caption = "State of the robot as recorded, by unit, and the actions at the ticks."
    return [draw("motion", caption, draw_motion)]


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
            # Over an image edges alone, which hide nothing of it.
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

    Where channels of a panel lie so far apart that none would be seen to move, it shows what they
    changed since the first reading, and the legend where each began.
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
    """Values (point, channel) as a curve a channel, no two of the first 18 alike.

    `held` holds each value until the next. Long curves are a bitmap in the page.
    """
    axis.set_prop_cycle(_LINES)
    axis.plot(
        time,
        values,
        lw=1.3,
        # A label that begins with an underscore would drop out of the legend.
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
    heights = [
        _IMAGE_IN if group.profile else _PANEL_IN if group.names[1:] else _SMALL_IN
        for group in groups
    ]
    shape = {"squeeze": False, "sharex": True, "height_ratios": heights}
    figure, axes = panels(_WIDTH_IN, sum(heights) + 0.5, len(groups), **shape)
    axes[-1, 0].set_xlabel("time since the recording began [s]")
    figure.align_ylabels(axes)
    return figure, list(axes[:, 0])


def _draw_curves(
    axis: Axes, stream: Stream, group: Group, zero: float, held: bool = False, changes: bool = False
) -> None:
    """Curves that break where the clock has a gap; of what moves little, its changes."""
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
    """A channel of the profile a line, the first on top, in colours that a few extremes keep.

    A column shows the last reading before it, and nothing where the clock has a gap.
    """
    clock = Clock("", "stream", stream.time)
    stop = max(stream.time[-1] + np.nan_to_num(clock.step_s), stream.time[0] + _LEAST_S)
    columns = np.linspace(stream.time[0], stop, _COLUMNS, endpoint=False)
    shown = last_at(stream.time, columns)
    image = stream.values[shown][:, group.indices].T
    image[:, columns - stream.time[shown] >= clock.shortest_gap_s] = np.nan
    low, high = np.nanpercentile(image, (1, 99.5))
    extent = (stream.time[0] - zero, stop - zero, len(image) - 0.5, -0.5)
    high = high if high > low else low + 1
    drawn = axis.imshow(image, vmin=low, vmax=high, aspect="auto", extent=extent)
    axis.grid(visible=False)
    axis.set_ylabel(f"depth: channel of {group.profile}")
    # Beside the panel: taken from it, its time axis would no longer stand below the curves'.
    bar = axis.inset_axes((1.01, 0.0, 0.015, 1.0))
    unit = f"[{group.unit}]" if group.unit else "(no unit)"
    axis.figure.colorbar(drawn, cax=bar, label=f"{group.profile} {unit}", extend="both")


def contacts(view: EpisodeView) -> tuple[Span, ...]:
    """Spans in which the needle touches something, by the force alone; none without a force.

    Several force channels (a wrench) count by the length of their departure from rest.
    """
    if view.sensor is None:
        return ()
    columns = force_columns(view.sensor)
    if not columns or len(view.sensor.time) < 3:
        return ()
    time = view.sensor.time
    force = view.sensor.values[:, columns].astype(np.float64)
    resting = time <= time[0] + _REST_S
    # Where times only repeat there is no step, and nothing is smoothed.
    window = max(1, round(_SMOOTHED_S / (usual_step(time) or _SMOOTHED_S))) | 1
    smooth = median_filter(force, size=(window, 1), mode="nearest")
    rest = np.median(smooth[resting], axis=0)
    # Of the smoothed force, by the steps of the raw one, which hold no slow motion; and at rest.
    noise = _spread(np.diff(force, axis=0)) / np.sqrt(2 * window) + _spread(smooth[resting])
    least = _LEAST_N if {view.sensor.channels.units[column] for column in columns} == {"N"} else 0.0
    departure = np.linalg.norm(smooth - rest, axis=1)
    enter = max(_ENTER * float(np.linalg.norm(noise)), least)
    spans: list[Span] = []
    for start, stop in runs((departure > enter * _LEAVE / _ENTER) & (departure > 0)):
        reached = np.flatnonzero(departure[start:stop] >= enter)
        if len(reached):
            # To the first reading after it, or the last.
            begin, end = time[start + reached[0]], time[min(stop, len(time) - 1)]
            if spans and begin - spans[-1].stop_s < _APART_S:
                begin = spans.pop().start_s
            spans.append(Span(float(begin), float(end)))
    return tuple(span for span in spans if span.length_s >= _SHORTEST_S)


def force_columns(sensor: Stream) -> list[int]:
    """The columns of a sensor whose names say force."""
    return [
        column
        for column, name in enumerate(sensor.channels.names)
        if "force" in name.lower() or name.lower() in ("fx", "fy", "fz")
    ]
