"""Put the evaluations of several experiments side by side, beside the baselines of all of them.

Writes report.html, experiments.csv and experiments.png into `compare.output`; the table with the
training times as Markdown beside that folder, for DVC tracks what is in it and a clock never says
the same twice.
"""

from pipeline.config import Params
from pipeline.durable import disk_full_named, fresh
from pipeline.evaluation import experiment_rows, experiments_table, read_experiments, write_rows
from pipeline.report import write_report
from pipeline.report.comparison import comparison_report
from stages.command import run


def main(params: Params) -> None:
    """Compare the evaluations in `compare.reports`."""
    output = params.compare.output
    experiments = read_experiments(params.compare.reports)
    output.mkdir(parents=True, exist_ok=True)
    files = [write_rows(output / "experiments.csv", experiment_rows(experiments))]
    files += write_report(output, comparison_report(experiments))
    markdown = output.with_name(f"{output.name}.md")
    with disk_full_named(markdown):
        fresh(markdown).write_text(experiments_table(experiments, markdown=True), encoding="utf-8")
    print(experiments_table(experiments))
    best = min(experiments, key=lambda one: one.error)
    print(f"lowest held-out error: {best.name}")
    print(f"{', '.join(str(file) for file in [*files, markdown])}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=("compare",)))
