"""Compare the evaluations of several experiments with one another and with the baselines.

Prints two tables with 95 % intervals: for the executed steps, then for the whole chunk. They
compare each experiment with the best one and with the best baseline, and say whether the difference
is resolved. Policies whose trainings differ only in train_head.seed are one row, with the spread
over the seeds; so are those that differ only in train_head.split.fold, with the test groups of all
folds.

Reads every folder in `compare.reports` that stages.evaluate wrote, and skips everything else there,
such as the logs of a training. Writes report.html, experiments.csv and experiments.png into
`compare.output`, and the tables as Markdown beside that folder.

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
        OutputKind,
        begins_with,
        claim,
        disk_full_named,
        fresh,
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

    table = OutputKind("a table of experiments", begins_with("| experiment |"))
    output = params.compare.output
    markdown = output.with_name(f"{output.name}.md")
    refuse_foreign(markdown, table)
    refuse_foreign(output, REPORT)
    experiments = read_experiments(params.compare.reports)
    claim(output, REPORT)
    files = [experiment_csv(experiments).write_csv(output / "experiments.csv")]
    files += write_report(output, comparison_report(experiments))
    tables = {span: experiment_table(experiments, span) for span in SPANS}
    with disk_full_named(markdown):
        text = "\n".join(line for errors in tables.values() for line in [*errors.markdown(), ""])
        fresh(markdown).write_text(text, encoding="utf-8")
    for span, errors in tables.items():
        print("\n".join(errors.text()))
        best = best_experiment(experiments, span)
        print(f"lowest test error of {SPANS[span]}: {best.name}\n")
    if experiments[0].error("executed").low is None:
        print(NO_INTERVAL)
    print(f"{', '.join(str(file) for file in [*files, markdown])}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=SECTIONS))
