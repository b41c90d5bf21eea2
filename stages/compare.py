"""Compare the evaluations of several experiments with one another and with the baselines.

Prints two tables with 95 % intervals: for the executed steps, then for the whole chunk. They
compare each experiment with the best one and with the best baseline, and say whether the difference
is resolved. Policies whose trainings differ only in train_head.seed are one row, with the spread
over the seeds; so are those that differ only in train_head.split.fold, with the test groups of all
folds.

Reads every folder in `compare.reports` that stages.evaluate wrote, and skips everything else there,
such as the logs of a training. Writes report.html, experiments.csv and experiments.png into
`compare.output`.

  python -m stages.compare                                   of bash experiments/experts.sh
  python -m stages.compare --set compare.reports=reports     reports/evaluate, reports/blind, …
"""

from typing import TYPE_CHECKING

from stages.command import run

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("compare",)


def main(params: "Params") -> None:
    """Compare the evaluations in `compare.reports`."""
    from pipeline.base.files import (
        REPORT,
        claim,
        refuse_foreign,
    )
    from pipeline.evaluate.experiments import (
        SPANS,
        best_experiment,
        experiment_csv,
        experiment_table,
        read_experiments,
    )
    from pipeline.evaluate.figures import NO_INTERVAL
    from pipeline.look.comparison import comparison_report
    from pipeline.look.page.writing import write_report

    output = params.compare.output
    refuse_foreign(output, REPORT)
    experiments = read_experiments(params.compare.reports)
    claim(output, REPORT)
    files = [experiment_csv(experiments).write_csv(output / "experiments.csv")]
    files += write_report(output, comparison_report(experiments))
    for span, words in SPANS.items():
        print("\n".join(experiment_table(experiments, span).text()))
        print(f"lowest test error of {words}: {best_experiment(experiments, span).name}\n")
    if experiments[0].error("executed").low is None:
        print(NO_INTERVAL)
    print(", ".join(map(str, files)))


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=SECTIONS))
