"""The page of several evaluations side by side."""

from collections.abc import Sequence
from functools import partial

from pipeline import plots
from pipeline.evaluation import FOOTNOTE, Experiment, experiment_errors
from pipeline.report.blocks import Picture, Report, Section, Table


def comparison_report(experiments: Sequence[Experiment]) -> Report:
    """The page of these experiments, of which the first are no better than the last."""
    best = min(experiments, key=lambda one: one.error)
    columns, rows = experiment_errors(experiments)
    return Report(
        title="Experiments side by side",
        summary=(
            f"{len(experiments)} policies judged on the same held-out ticks, beside the baselines "
            "of all of them."
        ),
        tiles=(("lowest held-out error [training std]", f"{best.error:.3f}"), ("by", best.name)),
        sections=(
            Section(
                "Errors",
                (
                    Table(
                        columns,
                        rows,
                        caption=f"Mean absolute errors; samples: chunks a tick whose mean was "
                        f"judged. {FOOTNOTE[0].upper()}{FOOTNOTE[1:]}.",
                        strong=frozenset({experiments.index(best)}),
                    ),
                    Picture(
                        "experiments",
                        "Held-out error of each experiment, coloured by expert; the baselines are "
                        "lines.",
                        partial(plots.comparison_of_experiments, experiments),
                    ),
                ),
            ),
        ),
    )
