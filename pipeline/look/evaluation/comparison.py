"""The page of several evaluations side by side; it knows no recordings, as that of one does."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from pipeline.evaluate.experiments import Experiment, experiment_table
from pipeline.evaluate.tables import FOOTNOTE
from pipeline.look.evaluation import pictures as plots
from pipeline.look.page.blocks import Picture, Report, Section
from pipeline.look.page.writing import sentence


def comparison_report(experiments: Sequence[Experiment]) -> Report:
    """The page of these experiments, of which the first are no better than the last."""
    best = min(experiments, key=lambda experiment: experiment.error)
    table = replace(
        experiment_table(experiments),
        caption=f"Mean errors; samples are chunks whose mean was judged. {sentence(FOOTNOTE)}",
        strong=frozenset({experiments.index(best)}),
    )
    caption = "Held-out error of each experiment, coloured by expert; the baselines are lines."
    draw = partial(plots.comparison_of_experiments, experiments)
    picture = Picture("experiments", caption, draw)
    return Report(
        title="Experiments side by side",
        summary=f"{len(experiments)} policies judged on the same held-out ticks.",
        tiles=(("lowest held-out error [training std]", f"{best.error:.3f}"), ("by", best.name)),
        sections=(Section("Errors", (table, picture)),),
    )
