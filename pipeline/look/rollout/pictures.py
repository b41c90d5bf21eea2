"""Rollouts -> pictures; the same rollouts give the same bytes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.evaluate.rollouts import RolloutEpisode, Rollouts, controller_name
from pipeline.look.page.style import INK, PALETTE, canvas, draw_strip, finish, panels
from pipeline.simulation.insertion import AT_LAYER_MM, FORCE_LIMIT_N, MISS_MM, OVERSHOOT_MM

_MOMENTS = 8
_NEAR_MM = 3.0
"""Around the target, what the nearer view of the paths shows."""
_REACH = 1.3
"""Of pictures, as a multiple of how far from the target episodes begin."""
_WIDTH = 9.0
_OTHER = "#999999"
"""Of an episode among many."""
_OUTCOMES = {True: ("inserted", PALETTE[0], "o"), False: ("not inserted", PALETTE[5], "X")}
_MANY = 100
"""Episodes from which on paths are pixels in the page, for thousands of lines are slow."""


def paths(rollouts: Rollouts) -> Figure:
    """The tip's ways seen from above, of policy and demonstrator; below, those near the target."""
    shown = [name for name in ("policy", "expert") if rollouts.of(name)]
    begins = [episode.trace.offset_mm[:1] for name in shown for episode in rollouts.of(name)]
    far = max(_NEAR_MM, _REACH * float(np.abs(np.concatenate(begins)).max()))
    size = _WIDTH * max(len(shown), 1.4) / 2, _WIDTH + 0.9
    figure, axes = panels(*size, 2, len(shown), squeeze=False)
    for column, name in zip(axes.T, shown, strict=True):
        _draw_paths(column[0], rollouts.of(name), far)
        _draw_paths(column[1], rollouts.of(name), _NEAR_MM)
        column[0].set_title(f"{controller_name(name)}: whole paths")
        column[1].set_title(f"{controller_name(name)}: the last {_NEAR_MM:g} mm")
    finish(figure, axes[0, 0], 3, "Seen from above, the target in the middle")
    return figure


def courses(episodes: Sequence[RolloutEpisode], strong: Mapping[str, RolloutEpisode]) -> Figure:
    """Place and force over time, a thin line an episode.

    `strong` are those that stand out, by what the legend says of them.
    """
    figure, axes = panels(_WIDTH, 10.0, 4)
    pixels = len(episodes) > _MANY
    for episode in episodes:
        _draw_course(axes, episode, color=_OTHER, lw=0.7, alpha=0.5, rasterized=pixels)
    for (label, episode), colour in zip(strong.items(), (PALETTE[1], INK), strict=False):
        _draw_course(axes, episode, color=colour, lw=2.4, label=label, zorder=5)
    _mark_limits(axes)
    figure.align_ylabels(axes)
    finish(
        figure, axes[0], 2, f"Place and force over time in {len(episodes)} episode(s) of the policy"
    )
    return figure


def filmstrip(episode: RolloutEpisode, title: str) -> Figure:
    """What every view showed at moments from begin to end."""
    trace = episode.trace
    ticks = np.unique(np.linspace(0, len(trace.time_s) - 1, _MOMENTS).round().astype(int))
    moments = trace.time_s[ticks].tolist()
    shown = [episode.frames(moment) for moment in moments]
    frames = {view: [images[view] for images in shown] for view in shown[0]}
    heights = [10 / _MOMENTS * image.shape[0] / image.shape[1] for image, *_ in frames.values()]
    figure = canvas(10.4, sum(heights) + 0.8)
    grid = figure.add_gridspec(len(frames), _MOMENTS, height_ratios=heights)
    draw_strip(figure, grid, frames, moments)
    figure.suptitle(title)
    return figure


def _draw_paths(axis: Axes, episodes: Sequence[RolloutEpisode], reach_mm: float) -> None:
    """Each from where it last comes within reach."""
    for episode in episodes:
        offset_mm = episode.trace.offset_mm
        (outside,) = np.nonzero(np.abs(offset_mm).max(axis=1) > reach_mm)
        style: dict[str, Any] = {"lw": 0.8, "alpha": 0.45, "rasterized": len(episodes) > _MANY}
        shown = offset_mm[outside[-1] if len(outside) else 0 :]
        axis.plot(*shown.T, color=_OUTCOMES[episode.success][1], **style)
    around = MISS_MM * np.exp(2j * np.pi * np.arange(91) / 90)
    label = f"{MISS_MM:g} mm from the target"
    axis.plot(around.real, around.imag, color=INK, lw=1.6, zorder=6, label=label)
    for outcome, (label, colour, marker) in _OUTCOMES.items():
        ends = [episode.trace.lateral_mm for episode in episodes if episode.success == outcome]
        style = {"s": 34, "color": colour, "edgecolors": "white", "lw": 0.6, "zorder": 7}
        axis.scatter(*np.reshape(ends, (-1, 2)).T, marker=marker, label=label, **style)
    axis.set(xlim=(-reach_mm, reach_mm), ylim=(-reach_mm, reach_mm), aspect="equal")
    axis.set(xlabel="x [mm]", ylabel="y [mm]")


def _draw_course(axes: Sequence[Axes], episode: RolloutEpisode, **style: Any) -> None:
    """From top to bottom: sideways from the target, height, distance to the layer, force."""
    trace = episode.trace
    shown = (np.hypot(*trace.offset_mm.T), trace.height_mm, trace.layer_mm, trace.force_n)
    for axis, values in zip(axes, shown, strict=True):
        axis.plot(trace.time_s, values, **style)


def _mark_limits(axes: Sequence[Axes]) -> None:
    """What `_draw_course` has drawn, and what an episode must keep to."""
    sideways, height, layer, force = axes
    for axis, limit in zip(axes, (MISS_MM, 0, -OVERSHOOT_MM, FORCE_LIMIT_N), strict=True):
        axis.axhline(limit, color=INK, lw=1, ls="--")
        axis.tick_params(labelbottom=axis is force)
        axis.set_xlim(axes[0].get_xlim())
    layer.axhspan(-AT_LAYER_MM, AT_LAYER_MM, color=PALETTE[2], alpha=0.35, lw=0)
    rest = f"green: within {AT_LAYER_MM:g}, dashed: {OVERSHOOT_MM:g} beyond it"
    sideways.set(title=f"sideways from the target [mm]; dashed: {MISS_MM:g}", ylim=(0, None))
    height.set_title("tip above the surface [mm]; dashed: the surface at rest")
    layer.set_title(f"tip to the layer [mm]; {rest}")
    force.set(title=f"force [N]; dashed: {FORCE_LIMIT_N:g}", xlabel="time [s]", ylim=(0, None))
