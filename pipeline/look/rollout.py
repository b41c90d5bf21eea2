"""The page of a policy's rollouts: how often it succeeds, and how it fails."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.evaluate.rollouts import (
    RolloutEpisode,
    Rollouts,
    SuccessRate,
    controller_name,
    error_bars,
)
from pipeline.look.page.blocks import Block, Outline, Picture, Report, Section, Text, next_steps
from pipeline.look.page.style import INK, PALETTE, canvas, draw_strip, finish, panels
from pipeline.look.page.writing import sentence
from pipeline.simulation.insertion import (
    AT_LAYER_MM,
    FORCE_LIMIT_N,
    HOLD_TICKS,
    MAX_TICKS,
    MISS_MM,
    OVERSHOOT_MM,
    TICK_S,
    InsertionTrace,
)

_INSERTION = (
    f"An episode succeeds where the needle punctures within {MISS_MM:.1f} mm of the target, rests "
    f"within {AT_LAYER_MM:g} mm of the layer for {HOLD_TICKS} ticks, never goes more than "
    f"{OVERSHOOT_MM:g} mm beyond it, never meets more than {FORCE_LIMIT_N:g} N, and all of this "
    f"within {MAX_TICKS * TICK_S:g} s. Anything else ends it, with its reason. The levels are "
    "`depth`, which begins above the target, so that the sensor suffices, `full`, which begins "
    "anywhere, and `moved`, in which target and tissue are also pushed on the way."
)
_TASK = "The environment itself says whether an episode succeeds, and with which reason it ends."
_CONTROLLERS = (
    "The demonstrator is the rule that made the training data, and sees what the simulation hides. "
    "With a stream off, the same policy sees its training mean. Late is the policy with a model "
    "that takes so long for a pass. All of them meet the same episodes."
)
_MOMENTS = 8
_WIDTH = 9.0
_OTHER = "#999999"
"""Colour of an episode among many."""
_GOOD, _WIDE = 0.9, 0.15
"""A rate from which a policy may go on to an arm; a width of its interval that says little."""
_THIN: dict[str, Any] = {"lw": 0.8, "alpha": 0.45, "rasterized": True}
"""A line among many. They are pixels in the page: thousands of lines are slow."""


def rollout_report(rollouts: Rollouts) -> Report:
    """The page of these rollouts; it shows those of `policy` in detail.

    The same rollouts give the same page: it names neither the time nor its own folder. Pictures ask
    the episodes for their frames when they are drawn.
    """
    rates, episodes = rollouts.rates(), rollouts.of("policy")
    shares = "; ".join(f"{controller_name(name)} {rate}" for name, rate in rates.items())
    inserts = all(episode.trace for episode in episodes)
    where = "needle insertion" if inserts else "environment"
    levels = f"level {rollouts.levels[0]}" if inserts else ", ".join(rollouts.levels)
    return Report(
        title=f"Rollouts of {rollouts.checkpoint}",
        verdict=(
            f"The policy succeeds in {sum(e.success for e in episodes)} of {len(episodes)} episodes"
        ),
        summary=(
            f"The policy acts in the simulated {where} and sees what its actions lead to. "
            f"Episodes that succeed at {levels}: {shares}."
        ),
        tiles=[("success of the policy", str(rates["policy"]))],
        sections=(
            Section(
                "Success",
                [Text(_INSERTION if inserts else _TASK), Text(_CONTROLLERS), rollouts.summary()],
            ),
            *_lateness(rollouts),
            *([Section("Where the needle went", _courses(rollouts))] if inserts else []),
            Section("Episodes closely", (), tuple(_filmstrips(rollouts))),
            Section("What was run", [Outline("Settings of the rollout", rollouts.settings)]),
            next_steps(*_advice(rollouts)),
        ),
    )


def _advice(rollouts: Rollouts) -> Iterator[str]:
    rates, failed = rollouts.rates(), [e.reason for e in rollouts.of("policy") if not e.success]
    policy = rates["policy"]
    for name, rate in rates.items():
        if name.endswith("off") and rate.rate >= policy.low:
            yield (
                f"With its {name} the policy may succeed as often: see whether that stream tells "
                "what the task needs (`vla-cache probe` for features)."
            )
    if failed:
        reason, count = Counter(failed).most_common(1)[0]
        yield f"Most failures end by: {reason} ({count}). Look at the worst episode's film above."
    if policy.high - policy.low > _WIDE:
        yield "Run more episodes (`rollout.episodes: 200`) before two policies are compared."
    if policy.rate < _GOOD:
        yield "Record more demonstrations, above all of what fails; docs/worse.md has the order."
    else:
        yield "`vla-cache serve` serves the policy, `vla-cache drive` runs it on an arm."


def _lateness(rollouts: Rollouts) -> Iterator[Section]:
    """Success against latency, if there are several latencies."""
    rates = rollouts.by_latency()
    if len(rates) > 1:
        words = "The same episodes with a model that takes longer for a pass. Bars are 95 %."
        picture = Picture("latency", words, partial(draw_latency, rates))
        yield Section("A late model", [picture])


def draw_latency(rates: Mapping[float, SuccessRate]) -> Figure:
    """The success of the policy against the duration of a model pass."""
    figure, axis = panels(_WIDTH, 3.6, 1, 1)
    centre, bars = error_bars(rates.values())
    axis.errorbar([*rates], centre, bars, fmt="o-", capsize=3, color=PALETTE[0])
    axis.set(xlabel="a pass of the model takes [ms]", ylabel="success [%]", ylim=(-2, 102))
    return figure


def worst_and_median(episodes: Sequence[RolloutEpisode]) -> dict[str, RolloutEpisode]:
    """The worst episode, and the median, halfway to the best; a single one is only the worst.

    Failures are worse than successes. Among equals, the greater the sum of the tip's distances from
    the target and from the layer (mm), the worse; without a needle, the longer the worse.
    """
    ordered = sorted(episodes, key=lambda episode: (episode.success, -_badness(episode)))
    both = {"worst": ordered[0], "median": ordered[len(ordered) // 2]}
    return both if both["median"] is not ordered[0] else {"worst": ordered[0]}


def _badness(episode: RolloutEpisode) -> float:
    missed = episode.figures
    return missed["lateral_mm"] + abs(missed["depth_mm"]) if episode.trace else episode.time_s


def _trace(episode: RolloutEpisode) -> InsertionTrace:
    assert episode.trace is not None, "the needle's pictures are drawn of insertions alone"
    return episode.trace


def _courses(rollouts: Rollouts) -> list[Block]:
    episodes = rollouts.of("policy")
    over_time = (
        "A thin line is an episode. The tip should be near the target before it goes below the "
        "surface, and come to rest in the green band. Force is the largest in each tick; it falls "
        "when the needle punctures."
    )
    strong = {f"{kind}, seed {e.seed}": e for kind, e in worst_and_median(episodes).items()}
    return [Picture("courses", over_time, partial(draw_courses, episodes, strong))]


def draw_courses(
    episodes: Sequence[RolloutEpisode], strong: Mapping[str, RolloutEpisode]
) -> Figure:
    """Place and force over time, with a thin line for each episode.

    `strong` are the episodes with a thick line, by their legend entry.
    """
    figure, axes = panels(_WIDTH, 10.0, 4)
    for episode in episodes:
        _draw_course(axes, episode, color=_OTHER, **_THIN)
    for (label, episode), colour in zip(strong.items(), (PALETTE[1], INK), strict=False):
        _draw_course(axes, episode, color=colour, lw=2.4, label=label, zorder=5)
    _mark_limits(axes)
    figure.align_ylabels(axes)
    finish(
        figure, axes[0], 2, f"Place and force over time in {len(episodes)} episode(s) of the policy"
    )
    return figure


def _draw_course(axes: Sequence[Axes], episode: RolloutEpisode, **style: Any) -> None:
    """Draw, from top to bottom: distance sideways, height, distance to the layer, force."""
    trace = _trace(episode)
    shown = (np.hypot(*trace.offset_mm.T), trace.height_mm, trace.layer_mm, trace.force_n)
    for axis, values in zip(axes, shown, strict=True):
        axis.plot(trace.time_s, values, **style)


def _mark_limits(axes: Sequence[Axes]) -> None:
    """Draw titles, and the limits that an episode must keep."""
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


def _filmstrips(rollouts: Rollouts) -> Iterator[Section]:
    for level in rollouts.levels:
        for kind, episode in worst_and_median(rollouts.of("policy", level)).items():
            called = f"level {level}" if episode.trace else level
            title = f"{kind.capitalize()}: seed {episode.seed}, {called}"
            caption = "What the cameras saw at moments from the beginning to the end."
            if episode.trace:
                caption += " While the needle presses and has not punctured, the layer gives way."
            draw = partial(draw_filmstrip, episode, f"{title}, {episode.reason}")
            name = f"filmstrip_{kind}" if len(rollouts.levels) == 1 else f"{level}_{kind}"
            yield Section(title, [Text(_ending(episode)), Picture(name, caption, draw)])


def _ending(episode: RolloutEpisode) -> str:
    """How the episode ended, in a sentence."""
    words = sentence(episode.reason)
    if episode.trace:
        depth_mm = episode.figures["depth_mm"]
        side = "short of" if depth_mm > 0 else "beyond"
        words += (
            f" {episode.figures['lateral_mm']:.2f} mm sideways from the target at the puncture, "
            f"{abs(depth_mm):.2f} mm {side} the layer in the end, at most "
            f"{episode.figures['overshoot_mm']:.2f} mm beyond it and "
            f"{episode.figures['max_force_n']:.2f} N, {episode.time_s:.1f} s."
        )
    return words if episode.trace else f"{words} {episode.time_s:.1f} s."


def draw_filmstrip(episode: RolloutEpisode, title: str) -> Figure:
    """The frames of every view at moments from beginning to end."""
    after = np.unique(np.linspace(0, episode.actions, _MOMENTS).round().astype(int)).tolist()
    shots = episode.frames(after)
    frames = {view: [shown[view][1] for shown in shots] for view in shots[0]}
    moments = [max(time_s for time_s, _ in shown.values()) for shown in shots]
    heights = [10 / _MOMENTS * image.shape[0] / image.shape[1] for image, *_ in frames.values()]
    figure = canvas(10.4, sum(heights) + 0.8)
    grid = figure.add_gridspec(len(frames), _MOMENTS, height_ratios=heights)
    draw_strip(figure, grid, frames, moments)
    figure.suptitle(title)
    return figure
