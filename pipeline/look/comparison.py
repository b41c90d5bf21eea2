"""The page of several evaluations side by side."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from pipeline.evaluate.baselines import BASELINES
from pipeline.evaluate.experiments import SPANS, Experiment, best_experiment, experiment_table
from pipeline.evaluate.figures import NO_INTERVAL
from pipeline.evaluate.tables import FOOTNOTE
from pipeline.look.evaluation import LABELS, STYLES, draw_bar
from pipeline.look.page.blocks import Picture, Report, Section, next_steps
from pipeline.look.page.style import INK, finish, panels
from pipeline.look.page.writing import sentence

_READING = (
    "Mean errors with 95 % intervals over groups of recordings, differences on the same groups. "
    "The best is chosen on these ticks"
)


def comparison_report(experiments: Sequence[Experiment]) -> Report:
    """The page of these experiments, in their order."""
    tables = [
        replace(
            experiment_table(experiments, span),
            caption=f"{_READING}. {sentence(FOOTNOTE)}",
            strong=frozenset({experiments.index(best_experiment(experiments, span))}),
        )
        for span in SPANS
    ]
    caption = (
        "Test error of each experiment with 95 % intervals; a dot is a seed, the baselines are "
        "lines."
    )
    picture = Picture("experiments", caption, partial(draw_experiments, experiments))
    summary = (
        f"{len(experiments)} experiment(s) judged on the same test ticks, of "
        f"{len(experiments[0].groups)} group(s) of recordings."
    )
    if experiments[0].error("executed").low is None:
        summary += f" {sentence(NO_INTERVAL)}"
    return Report(
        title="Experiments side by side",
        verdict=_verdict(experiments),
        summary=summary,
        sections=(
            Section("Errors", (*tables, picture)),
            next_steps(
                "Train the best with several values of `train_head.seed`: seeds differ, too.",
                "Roll out the best two (`vla-cache rollout`): errors do not tell who succeeds.",
            ),
        ),
    )


def _verdict(experiments: Sequence[Experiment]) -> str:
    """Which experiment errs least in what is executed, and whether its lead is resolved."""
    best = best_experiment(experiments, "executed")
    others = [other for other in experiments if other is not best]
    leads = [best.minus(other, "executed").resolved for other in others]
    if not others:
        return f"{best.name} stands alone"
    lead = "and is ahead of all others" if all(leads) else "but its lead is not resolved"
    return f"{best.name} errs least in what is executed, {lead}"


def draw_experiments(experiments: Sequence[Experiment]) -> Figure:
    """Errors of the executed steps and of the whole chunk, with intervals, seeds and baselines."""
    figure, axes = panels(11.0, 0.36 * len(experiments) + 2.8, 1, len(SPANS), sharey=True)
    for axis, (span, words) in zip(axes, SPANS.items(), strict=True):
        for place, experiment in enumerate(experiments):
            draw_bar(axis, place, experiment.error(span), 0.72, color=STYLES["policy"]["color"])
            if len(experiment.seeds) > 1:
                seeds = experiment.by_seed(span)
                axis.plot(seeds, np.full(len(seeds), place), ls="", marker=".", ms=4, color=INK)
        for method in BASELINES:
            style = {key: STYLES[method][key] for key in ("color", "ls")}
            value = min(experiment.error(span, method).value for experiment in experiments)
            axis.axvline(value, lw=2, label=LABELS[method], **style)
        axis.set(title=words, xlabel="mean absolute error [training std]")
        axis.grid(axis="y", visible=False)
    axes[0].set_yticks(range(len(experiments)), [experiment.name for experiment in experiments])
    axes[0].invert_yaxis()
    finish(figure, axes[0], 3, "Error on test ticks, from one store (left is better)")
    return figure
