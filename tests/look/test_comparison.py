"""Experiments side by side are one page: a table for each span of the chunk, and one picture."""

import numpy as np
import pytest

from pipeline.base.text import Table
from pipeline.evaluate.baselines import BASELINES
from pipeline.evaluate.experiments import SPANS, Experiment, JudgedDocument
from pipeline.look.comparison import comparison_report
from pipeline.look.page.writing import PAGE, write_report


@pytest.fixture
def experiments() -> list[Experiment]:
    """Of two experts, the second with two seeds; diffusion errs less in the whole chunk alone."""
    groups = np.linspace(-0.1, 0.1, 6)

    def experiment(expert: str, executed: list[float], overall: list[float]) -> Experiment:
        policy = {"executed": executed, "overall": overall}
        errors = {("policy", span): np.add.outer(policy[span], groups) for span in SPANS}
        rules = {
            (way, span): np.full((len(executed), 6), 0.7) for way in BASELINES for span in SPANS
        }
        judged = {"model_type": expert, "fusion_strategy": "concat", "recipe": expert}
        judged |= {"parameters": 1000, "samples": 1, "seed": 0}
        return Experiment(
            name=f"{expert}-concat",
            judged=JudgedDocument.model_validate(
                {"policy": judged, "on": {"test": {}}, "drawn": None}
            ),
            seeds=tuple(range(len(executed))),
            groups=tuple(f"demo/{k}" for k in range(6)),
            entries={span: np.full(6, 10.0) for span in SPANS},
            errors=errors | rules,
        )

    return [
        experiment("regression", [0.3], [0.5]),
        experiment("diffusion", [0.4, 0.6], [0.35, 0.45]),
    ]


@pytest.mark.slow
def test_the_page_is_sound(experiments, tmp_path, assert_page_is_sound):
    write_report(tmp_path, comparison_report(experiments))
    assert_page_is_sound(tmp_path / PAGE)


def test_experiments_are_one_page(experiments: list[Experiment]) -> None:
    report = comparison_report(experiments)
    executed, chunk = report.blocks(Table)
    assert list(executed.columns[-4:]) == ["expert", "fusion", "samples", "parameters"]
    assert executed.columns[1] == "what is executed [training std]"
    assert chunk.columns[1] == "the whole chunk [training std]"
    assert [[*row[5:7]] for row in executed.rows[:2]] == [[1, 1], [2, 1]]
    assert (executed.strong, chunk.strong) == ({0}, {1})
    assert len(executed.rows) == 2 + len(BASELINES)
    assert report.verdict.startswith("regression-concat errs least in what is executed, ")
    assert report.verdict.endswith(("ahead of all others", "lead is not resolved"))
    assert comparison_report(experiments[:1]).verdict == "regression-concat stands alone"
