"""The page of an evaluation: how well a policy does, where it errs, and what it was made of."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.text import Table
from pipeline.evaluate import tables
from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.baselines import METHODS
from pipeline.evaluate.evaluation import Evaluation, trained_on_too
from pipeline.evaluate.figures import Figure as Merit
from pipeline.evaluate.figures import best_baseline, error, rivalry, with_unit
from pipeline.look.page.blocks import Block, Outline, Picture, Report, Section, Text, next_steps
from pipeline.look.page.style import (
    INK,
    PALETTE,
    finish,
    panels,
    shorten_middle,
)
from pipeline.look.page.writing import sentence
from pipeline.store import Episode, FeatureStore, episode_name
from pipeline.train.batches import Ticks, evenly
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison

LABELS = {way: f"baseline: {words}" for way, words in tables.HEADINGS.items()} | {
    "policy": "policy"
}
"""Legend entry of each method."""
STYLES: dict[str, dict[str, Any]] = {
    "policy": {"color": "#0072B2", "marker": "o", "ls": "-", "zorder": 5, "lw": 2.4, "ms": 6.5},
    # An open, larger square stays visible when the median action is almost no motion.
    "zero_action": {"color": "#E69F00", "marker": "s", "ls": "--", "fillstyle": "none", "ms": 8.5},
    "median_action": {"color": "#009E73", "marker": "^", "ls": "-."},
    "repeat_last": {"color": "#CC79A7", "marker": "D", "ls": ":"},
    "linear_fit": {"color": "#D55E00", "marker": "v", "ls": "-."},
    "nearest_neighbour": {"color": "#56B4E9", "marker": "P", "ls": "--"},
}
_CHUNK = PALETTE[5]
"""Colour of whole chunks."""
_POLICY = STYLES["policy"]["color"]
_FEW = 10
"""Fewer groups of test recordings say little."""
_DOING = {
    "zero_action": "standing still",
    "median_action": "the median action",
    "repeat_last": "repeating the last action",
    "linear_fit": "a linear fit on the two past actions",
    "nearest_neighbour": "copying the nearest neighbour",
}
"""The baselines, as a sentence has them."""
_INSTANTS = 5
"""Ticks of an episode at which whole chunks are shown."""
_EPISODES = 40
"""The most rows of the table of episodes."""
_PAIRED = (
    "Policy minus best baseline in each figure, by the paired bootstrap over groups of test "
    "recordings: not resolved is a difference whose 95 % interval holds 0."
)


def evaluation_report(evaluation: Evaluation, rollout: str = "") -> Report:
    """The page of an evaluation.

    `rollout` is the path from this page to the page of the rollouts, if there is one. The same
    evaluation gives the same page: it names neither the time nor its own folder.
    """
    comparison, policy = evaluation.comparison, evaluation.judged["policy"]
    # The overall error counts dimensions that hardly move like the others.
    still = tables.still_dimensions(comparison)
    notes = [note for note in (trained_on_too(evaluation.checkpoint), still) if note]
    return Report(
        title=f"Evaluation of {evaluation.name}",
        verdict=_verdict(comparison, bool(evaluation.checkpoint.shape.anchors)),
        summary=(
            f"{policy['model_type']} expert, {policy['fusion_strategy']} fusion, step "
            f"{policy['step']}, {policy['parameters']:,} parameters, judged on "
            f"{comparison.ticks:,} test ticks of {len(comparison.episodes)} episode(s) of "
            f"{evaluation.store.path.name}, {policy['samples']} chunk(s) a tick."
            f"{''.join(f' {sentence(note)}' for note in notes)}"
        ),
        tiles=_tiles(comparison),
        sections=(
            Section("Error of what is executed", _executed(comparison, rollout)),
            Section("Error of the whole chunk", _chunk(evaluation)),
            *([Section("Phases", _phases(comparison))] if tables.by_phase(comparison) else []),
            Section("Dimensions and steps ahead", _dimensions(evaluation)),
            Section("Episodes", [_episodes(evaluation), _worst(evaluation)]),
            Section("Which streams are used", _modalities(evaluation.study)),
            Section("What was judged", _documents(evaluation)),
            next_steps(*_advice(evaluation, rollout)),
        ),
    )


def _verdict(comparison: Comparison, anchored: bool) -> str:
    """The policy's executed steps beside the best baseline, in words."""
    rivals = rivalry(comparison.executed)
    best = _DOING[rivals.best]
    if rivals.ratio is None or rivals.difference.resolved is False:
        return f"Not told apart from {best}, in what is executed"
    if rivals.ratio <= 1:
        return f"In what is executed, the policy errs {_times(1 / rivals.ratio)} less than {best}"
    worse = f"In what is executed, the policy is {_times(rivals.ratio)} worse than {best}"
    return worse + ", as an anchored policy may be" * anchored


def _times(ratio: float) -> str:
    """`3.2 times`; `8 %` for less than twice."""
    return f"{ratio - 1:.0%}" if ratio < 2 else f"{ratio:.2g} times"


def _advice(evaluation: Evaluation, rollout: str) -> Iterator[str]:
    executed = evaluation.comparison.executed
    rivals, groups = rivalry(executed), len(np.unique(executed.cells.group))
    if rivals.verdict != "better" and evaluation.checkpoint.shape.anchors:
        yield (
            "The policy is anchored: it errs more at its first step on purpose (docs/late.md), so "
            "judge it by rollouts."
        )
    elif rivals.verdict != "better":
        yield (
            "Look above at which streams are used and at the training's curves (`dvc plots show`), "
            "then go through docs/worse.md: it says which switch first."
        )
    if groups < _FEW:
        yield (
            f"Hold out more: {groups} group(s) of test recordings leave wide intervals, or none. "
            "Five folds test each recording once (docs/training.md)."
        )
    if rollout:
        yield "See the rollouts: whether the task succeeds, errors cannot tell."
    elif rivals.verdict == "better":
        yield "Count successes: `vla-cache rollout` in a simulation, `vla-cache drive` on an arm."


def _tiles(comparison: Comparison) -> list[tuple[str, str]]:
    tiles: list[tuple[str, str]] = []
    for scope, part in (("executed", comparison.executed), ("chunk", comparison)):
        rivals = rivalry(part)
        value, _, ends = rivals.policy.text().partition(" ")
        tiles.append((f"{scope}: overall error [training std] {ends}", value))
        times = "–" if rivals.ratio is None else f"{rivals.ratio:.3g} times"
        tiles.append((f"{scope}: the best baseline's ({tables.HEADINGS[rivals.best]})", times))
    return [*tiles, ("test episodes", f"{len(comparison.episodes)}")]


def _executed(comparison: Comparison, rollout: str) -> list[Block]:
    title, _ = tables.titles(comparison)
    errors = tables.error_table(comparison.executed)
    caption = (
        "Overall error of policy and baselines, of what is executed and of the whole chunk, with "
        "95 % intervals where there are two groups of test recordings or more."
    )
    success = "Whether the task succeeds, recorded ticks do not tell"
    return [
        Text(f"{sentence(title)} {sentence(tables.verdicts(comparison))}"),
        replace(errors, caption=sentence(tables.FOOTNOTE)),
        Picture("methods", caption, partial(draw_methods, comparison)),
        Text(f"{success}: stages.rollout does." if rollout else f"{success}.", rollout),
    ]


def draw_methods(comparison: Comparison) -> Figure:
    """The overall error of policy and baselines with 95 % intervals, executed and whole chunk."""
    scopes = {"what is executed": comparison.executed, "the whole chunk": comparison}
    figure, axes = panels(9.4, 3.6, 1, len(scopes), sharey=True)
    for axis, (title, part) in zip(axes, scopes.items(), strict=True):
        for place, method in enumerate(METHODS):
            draw_bar(axis, place, error(part, method), 0.7, color=STYLES[method]["color"])
        axis.set(title=title, xlabel="mean absolute error [training std]")
        axis.grid(axis="y", visible=False)
    axes[0].set_yticks(range(len(METHODS)), [tables.HEADINGS[method] for method in METHODS])
    axes[0].invert_yaxis()
    figure.suptitle("Overall error on test ticks (left is better)")
    return figure


def draw_bar(axis: Axes, place: int, merit: Merit, height: float, **style: Any) -> None:
    """Draw a bar to the right, and its interval if it has one."""
    axis.barh(place, merit.value, height, **style)
    if merit.low is not None and merit.high is not None:
        axis.plot([merit.low, merit.high], [place, place], color=INK, lw=1.6, marker="|")


def _chunk(evaluation: Evaluation) -> list[Block]:
    comparison = evaluation.comparison
    _, title = tables.titles(comparison)
    return [
        replace(tables.error_table(comparison), caption=sentence(title)),
        Text(sentence(tables.samples_text(comparison, evaluation.energy))),
        replace(tables.difference_table(comparison), caption=_PAIRED),
    ]


def _phases(comparison: Comparison) -> list[Block]:
    caption = f"Overall error [training std] by phase. {sentence(tables.PHASE_RULE)}"
    return [replace(tables.phase_table(comparison), caption=caption)]


def _dimensions(evaluation: Evaluation) -> list[Block]:
    """Errors over the whole chunk, by dimension and by step."""
    comparison = evaluation.comparison
    columns = ["dimension", "unit", *(tables.HEADINGS[method] for method in METHODS)]
    errors = [comparison.scores[method].mae for method in METHODS]
    rows = list(zip(comparison.names, comparison.units, *errors, strict=True))
    horizon = (
        "Mean absolute error of policy and baselines by how far ahead an action lies; the bands of "
        "the policy and of the best baseline, where there are some, are 95 % intervals."
    )
    draw = partial(draw_horizon, comparison, evaluation.store.action_hz)
    return [
        Table(columns, rows, caption="Mean absolute error by dimension."),
        Picture("horizon", horizon, draw),
    ]


def draw_horizon(comparison: Comparison, action_hz: float | None) -> Figure:
    """Mean absolute error by steps ahead, with a panel for each action group."""
    ahead = "steps ahead" if action_hz is None else f"steps ahead [{1000 / action_hz:.0f} ms each]"
    groups = comparison.varying_groups()
    figure, (axes,) = panels(max(4.6 * len(groups), 9.4), 4.4, 1, len(groups), squeeze=False)
    for axis, group in zip(axes, groups, strict=True):
        for method in METHODS:
            errors = group.mean(comparison.scores[method].mae_horizon)
            style = {"lw": 1.5, "ms": 5, "label": LABELS[method]} | STYLES[method]
            axis.plot(np.arange(len(errors)), errors, **style)
        for method in ("policy", best_baseline(comparison, group)):
            _draw_band(axis, comparison, method, group)
        axis.set(title=f"{group.name}, {len(group.dimensions)} dimension(s)", xlabel=ahead)
        axis.set_ylabel(with_unit("mean absolute error", group.unit))
        axis.set_ylim(bottom=0)
        axis.xaxis.get_major_locator().set_params(integer=True)
    finish(figure, axes[0], 3, "Error over the action chunk (lower is better)")
    return figure


def _draw_band(axis: Axes, comparison: Comparison, method: str, group: ActionGroup) -> None:
    """Draw the 95 % interval of a group's error at each step."""
    steps = range(comparison.cells.entries.shape[1])
    parts = (comparison.part(steps=slice(step, step + 1)) for step in steps)
    errors = [error(part, method, group) for part in parts]
    low, high = np.array([(step.low, step.high) for step in errors], float).T
    axis.fill_between(steps, low, high, color=STYLES[method]["color"], alpha=0.18, lw=0)


def _episodes(evaluation: Evaluation) -> Table:
    """The test episodes, the worst first."""
    comparison, store = evaluation.comparison, evaluation.store
    best = best_baseline(comparison)
    errors = {method: comparison.overall_by_episode(method) for method in ("policy", best)}
    rows: list[tuple[object, ...]] = []
    for place in comparison.ranked()[::-1][:_EPISODES]:
        episode = store.episodes[comparison.episodes[place]]
        policy, rule = (float(errors[method][place]) for method in ("policy", best))
        ticks = int((evaluation.predictions.episodes == episode.index).sum())
        rows.append((episode_name(episode), ticks, policy, rule, policy / rule if rule else None))
    caption = "Overall error [training std] by episode, the worst first"
    if len(rows) < len(comparison.episodes):
        caption += f"; the worst {len(rows)} of {len(comparison.episodes)}"
    heads = ["episode", "test ticks", "policy", tables.HEADINGS[best], "policy / baseline"]
    return Table(heads, rows, f"{caption}.")


def _worst(evaluation: Evaluation) -> Picture:
    """The worst episode in detail."""
    comparison, predictions, store = evaluation.comparison, evaluation.predictions, evaluation.store
    index = comparison.episodes[comparison.ranked()[-1]]
    episode = store.episodes[index]
    ticks = evenly(_whole(predictions, index), _INSTANTS)
    caption = (
        f"The worst episode, {episode_name(episode)}. Instruction: {episode.instruction}. Recorded "
        "action, the policy's next action at every tick, and its whole chunks at the dotted ticks."
    )
    shown = comparison, predictions, store, episode, ticks
    return Picture("episode_worst", caption, partial(draw_chunks, *shown))


def _whole(predictions: Predictions, index: int) -> Ticks:
    """The judged ticks of an episode whose chunk ends within it; all of a very short episode."""
    here = predictions.episodes == index
    whole = here & predictions.valid.all(axis=1)
    return predictions.ticks[whole if whole.any() else here]


def draw_chunks(
    comparison: Comparison,
    predictions: Predictions,
    store: FeatureStore,
    episode: Episode,
    instants: NDArray[np.int64],
) -> Figure:
    """Recorded and predicted actions over time: the next at every tick, whole chunks at `instants`.

    `instants` are test ticks of the episode, store-global.
    """
    time_s = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    time_s = time_s - time_s[0]
    here = predictions.episodes == episode.index
    at = time_s[predictions.ticks[here] - episode.ticks.start]
    shown = comparison.varying()
    height = 1.15 * len(shown) + 1.7
    figure, axes = panels(11.0, height, len(shown), 1, squeeze=False, sharex=True)
    places = np.flatnonzero(np.isin(predictions.ticks, instants))
    for axis, dimension in zip(axes[:, 0], shown, strict=True):
        recorded, predicted = predictions.recorded[here, 0], predictions.predicted[here, 0]
        axis.plot(at, recorded[:, dimension], color=INK, lw=2.2, label="recorded")
        axis.plot(at, predicted[:, dimension], color=_POLICY, lw=1.6, label="policy, next action")
        axis.set_ylabel(with_unit(comparison.names[dimension], comparison.units[dimension]))
        label = "policy, whole chunk at the dotted ticks"
        for place in places:
            chunk = predictions.predicted[place, predictions.valid[place], dimension]
            ahead = time_s[predictions.ticks[place] - episode.ticks.start :][: len(chunk)]
            axis.axvline(ahead[0], color=INK, lw=0.8, ls=":", zorder=1)
            axis.plot(ahead, chunk, color=_CHUNK, lw=2, zorder=6, label=label)
            axis.plot(ahead[0], chunk[0], color=_CHUNK, marker="o", ms=5, zorder=6)
            label = ""
    axes[-1, 0].set_xlabel("time since the episode began [s]")
    figure.align_ylabels(axes)
    overall = comparison.overall_by_episode("policy")[comparison.episodes.index(episode.index)]
    name = shorten_middle(episode_name(episode), 14, 28)
    finish(figure, axes[0, 0], 3, f"{name}: overall error {overall:.3f} [training std]")
    return figure


def _modalities(study: AblationStudy | None) -> list[Block]:
    if study is None:
        return [Text("Not judged: `evaluate.modalities` is off, or no episode is long enough.")]
    return [
        Text(f"{sentence(tables.evaluated_on(study))} {sentence(tables.ABLATION_FOOTNOTE)}"),
        replace(tables.ablation_table(study), caption=""),
        *(Text(sentence(note)) for note in study.notes),
    ]


def _documents(evaluation: Evaluation) -> list[Block]:
    checkpoint = evaluation.checkpoint
    source = {key: value for key, value in checkpoint.source.items() if key != "feature_spec"}
    return [
        Outline("train_head, as trained", checkpoint.params.model_dump(mode="json")),
        Outline("Feature spec of its store", checkpoint.source["feature_spec"]),
        Outline("Streams and ticks of its store", source),
        Outline("What was judged, and on what (judged.json)", evaluation.judged),
    ]
