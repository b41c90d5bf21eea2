"""The pictures of what was felt and how the robot moved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.data import Stream
from pipeline.look.page.style import canvas
from pipeline.look.recording.draw_channels import Group, groups, short_names
from pipeline.look.recording.draw_drawing import CONTACT, curves, legend_beside, words
from pipeline.look.recording.draw_thinning import columns, curve
from pipeline.look.recording.facts import Contact, EpisodeView

_TIME = "time since the recording began [s]"
_WIDTH_IN, _PANEL_IN, _SMALL_IN, _IMAGE_IN = 10.0, 1.75, 1.0, 2.6
_STANDS_STILL = 0.2
"""Of the span of a group: where its channels move less than this, their changes are drawn."""


@dataclass(frozen=True)
class _Panel:
    stream: Stream
    group: Group
    title: str = ""
    steps: bool = False
    changes: bool = False
    """Whether channels that lie far apart may be drawn as what they change since the first."""


def sensor(view: EpisodeView, contacts: Sequence[Contact]) -> Figure:
    """Curves of the sensor by unit above, a profile such as the A-scan as an image below.

    The spans in contact are shaded in all panels, over one axis of time. Beyond about 5,000
    readings a curve is the least and greatest of each bin of time, an image the mean.
    """
    if view.sensor is None:
        return words("The episode has no sensor stream.")
    found = groups(view.sensor.channels)
    found = sorted(found, key=lambda group: group.is_profile)
    panels = [_Panel(view.sensor, group) for group in found]
    figure, axes = _panels(panels)
    for axis, panel in zip(axes, panels, strict=True):
        (_profile if panel.group.is_profile else _curves)(axis, panel, view.zero)
        _mark_contacts(axis, contacts, view.zero, panel.group.is_profile)
        if not panel.group.is_profile:
            legend_beside(axis)
    return figure


def motion(view: EpisodeView) -> Figure:
    """State and poses in panels by unit, and below them the actions, held from tick to tick.

    Where channels of a panel lie so far apart that none would be seen to move, it shows what they
    changed since the first reading, and the legend where each began.
    """
    panels = _motion_panels(view)
    if not panels:
        return words("The episode has no state, no poses and no actions.")
    figure, axes = _panels(panels)
    for axis, panel in zip(axes, panels, strict=True):
        _curves(axis, panel, view.zero)
        axis.set_title(panel.title, loc="left")
        legend_beside(axis)
    return figure


def _motion_panels(view: EpisodeView) -> list[_Panel]:
    state, poses, action = view.state, view.poses, _action(view)
    panels: list[_Panel] = []
    for title, stream in (("state", state), ("poses", poses)):
        shown = set() if state is None or title == "state" else set(state.channels.names)
        if stream is None or set(stream.channels.names) <= shown:
            continue
        panels += _titled(title, stream, steps=False)
    if action is not None:
        said = "actions as recorded" if view.timeline is None else "actions at the ticks"
        panels += _titled(said, action, steps=True)
    return panels


def _titled(title: str, stream: Stream, steps: bool) -> list[_Panel]:
    """A panel a group; the first of them says whose they are."""
    found = [
        _Panel(stream, group, steps=steps, changes=not steps) for group in groups(stream.channels)
    ]
    return [replace(found[0], title=title), *found[1:]]


def _action(view: EpisodeView) -> Stream | None:
    line = view.timeline
    if line is None:
        return view.action
    return Stream(line.action_channels, line.time, line.action)


def _panels(panels: Sequence[_Panel]) -> tuple[Figure, list[Axes]]:
    heights = [_height(one.group) for one in panels]
    figure = canvas(_WIDTH_IN, sum(heights) + 0.5)
    axes = figure.subplots(
        len(panels), 1, squeeze=False, sharex=True, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    axes[-1].set_xlabel(_TIME)
    figure.align_ylabels(axes)
    return figure, list(axes)


def _height(group: Group) -> float:
    if group.is_profile:
        return _IMAGE_IN
    return _SMALL_IN if group.name == "gripper" else _PANEL_IN


def _curves(axis: Axes, panel: _Panel, zero: float) -> None:
    stream, group = panel.stream, panel.group
    values = stream.values[:, group.indices]
    shown = curve(stream.time, values)
    labels, said = short_names(group.names), group.label
    drawn = shown.values
    if panel.changes and np.ptp(values, axis=0).max() < _STANDS_STILL * np.ptp(values):
        drawn = drawn - values[0]
        labels = [f"{one} from {at:.4g}" for one, at in zip(labels, values[0], strict=True)]
        said = f"change of {said}" if said else "change"
    curves(axis, shown.time - zero, drawn, labels, panel.steps)
    axis.set_ylabel(said)
    if shown.bin_s is not None:
        thinned = f"least and greatest of each {1000 * shown.bin_s:.0f} ms"
        axis.set_title(thinned, loc="right", fontsize=8)


def _profile(axis: Axes, panel: _Panel, zero: float) -> None:
    """A channel of the profile a line, the first on top, in colours that a few extremes keep."""
    stream, group = panel.stream, panel.group
    first, last = group.indices[0], group.indices[-1]
    together = last - first + 1 == len(group.indices)
    picked = slice(first, last + 1) if together else list(group.indices)
    edges, image = columns(stream.time, stream.values[:, picked])
    finite = image[np.isfinite(image)]
    low, high = np.percentile(finite, (1, 99.5))
    drawn = axis.imshow(
        image,
        cmap=mpl.colormaps["viridis"].with_extremes(bad="none"),
        vmin=low,
        vmax=high if high > low else low + 1,
        aspect="auto",
        extent=(edges[0] - zero, edges[-1] - zero, len(image) - 0.5, -0.5),
    )
    axis.grid(visible=False)
    axis.set_ylabel(f"depth: channel of {group.name or 'the profile'}")
    # Beside the panel: taken from it, its time axis would no longer stand below the curves'.
    bar = axis.inset_axes((1.01, 0.0, 0.015, 1.0))
    unit = f"[{group.unit}]" if group.unit else "(no unit)"
    axis.figure.colorbar(drawn, cax=bar, label=f"{group.name or 'value'} {unit}", extend="both")


def _mark_contacts(axis: Axes, contacts: Sequence[Contact], zero: float, over_image: bool) -> None:
    """Shaded over curves; over an image two edges and a band on top, which hide nothing of it."""
    for number, one in enumerate(contacts):
        start, stop = one.start_s - zero, one.stop_s - zero
        if not over_image:
            label = "in contact" if number == 0 else None
            axis.axvspan(start, stop, color=CONTACT, alpha=0.22, lw=0, label=label)
            continue
        for edge in (start, stop):
            axis.axvline(edge, color=CONTACT, lw=1.4, ls="--")
        across = axis.get_xaxis_transform()
        axis.plot([start, stop], [1.02, 1.02], color=CONTACT, lw=4, transform=across, clip_on=False)
        if number == 0:
            axis.text((start + stop) / 2, 1.04, "in contact", ha="center", transform=across, size=8)
