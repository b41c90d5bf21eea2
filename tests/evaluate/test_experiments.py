"""Evaluations side by side: seeds in one row, differences paired by group, resolved or not."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import ConfigError
from pipeline.base.text import Table
from pipeline.evaluate.baselines import BASELINES, METHODS
from pipeline.evaluate.evaluation import JUDGED
from pipeline.evaluate.experiments import (
    best_experiment,
    experiment_csv,
    experiment_table,
    read_experiments,
)
from pipeline.evaluate.tables import GROUPS

Written = Callable[..., Path]
HARD = np.linspace(0.2, 0.6, 12)
"""The error of a policy in each of twelve groups."""


@pytest.fixture
def written(tmp_path: Path) -> Written:
    """`written(name, executed, seed=0, ...)`: an evaluation by hand; a chunk errs twice as much.

    Group k, from `first` on, has k + 1 executed entries and 8 times as many in all.
    """

    def write(
        name: str,
        executed: np.ndarray,
        seed: int = 0,
        recipe: str | None = None,
        first: int = 0,
        **judged: Any,
    ) -> Path:
        folder = tmp_path / "reports" / name
        folder.mkdir(parents=True)
        places = range(first, first + len(executed))
        names = [f"demo/{k:02}" for k in places]
        rules = {way: 0.3 + 0.1 * place for place, way in enumerate(BASELINES)}
        columns: dict[str, list[Any]] = {"group": names}
        for span, times in (("executed", 1), ("overall", 2)):
            entries = (1 if times == 1 else 8) * (np.array(places) + 1)
            columns[f"{span}_entries"] = entries.tolist()
            errors = {"policy": executed} | {w: np.full(len(executed), e) for w, e in rules.items()}
            columns |= {f"{way}_{span}": (times * errors[way]).tolist() for way in METHODS}
        Table(list(columns), list(zip(*columns.values(), strict=True))).write_csv(folder / GROUPS)
        policy = {
            "model_type": "regression",
            "fusion_strategy": "concat",
            "step": 10,
            "parameters": 100,
            "samples": 1,
            "seed": seed,
            "recipe": recipe or name,
        }
        on = {"horizon": 8, "test": dict.fromkeys(names, "its digest")}
        document = {"policy": policy, "drawn": None, "on": on} | judged
        (folder / JUDGED).write_text(json.dumps(document))
        return folder.parent

    return write


def test_errors_are_weighted_by_entries_and_differences_paired_by_group(written: Written) -> None:
    rng = np.random.default_rng(0)
    written("a", HARD)
    reports = written("b", HARD + 0.02 + 0.001 * rng.normal(size=12))
    a, b = read_experiments(reports)
    weights = np.arange(1, 13)
    assert a.error("executed").value == pytest.approx((HARD @ weights) / weights.sum(), rel=1e-5)
    assert a.error("overall").value == pytest.approx(2 * a.error("executed").value, rel=1e-5)
    alone, apart = a.error("executed"), b.minus(a, "executed")
    # Groups differ by far more than the two policies do in any of them.
    assert alone.high - alone.low > 0.1
    assert apart.value == pytest.approx(0.02, abs=0.002)
    assert 0.015 < apart.low < apart.high < 0.025
    assert apart.resolved
    assert best_experiment([b, a], "executed") is a


def test_a_table_says_which_differences_are_resolved(written: Written) -> None:
    rng = np.random.default_rng(0)
    written("a", HARD)
    written("like-a", HARD + 0.05 * rng.normal(size=12))
    reports = written("worse", HARD + 0.2)
    table = experiment_table(read_experiments(reports), "executed")
    rows = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}
    beside = {name: row["minus the best"] for name, row in rows.items()}
    best = min(("a", "like-a"), key=lambda name: rows[name]["what is executed [training std]"])
    assert beside.pop(best) == "it is"
    assert beside["worse"].endswith("): resolved")
    (other,) = {"a", "like-a"} - {best}
    assert beside[other].endswith("): not resolved")
    assert rows["worse"]["minus the best baseline"].endswith("resolved (zero)")
    assert rows["baseline: linear fit"]["what is executed [training std]"].startswith("0.600")

    file = experiment_csv(read_experiments(reports))
    (worse,) = (dict(zip(file.columns, row, strict=True)) for row in file.rows if row[0] == "worse")
    assert worse["executed_minus_best_is"] == "resolved"
    low, high = worse["executed_minus_best_low"], worse["executed_minus_best_high"]
    assert low < worse["executed_minus_best"] < high
    assert worse["overall_best_baseline"] == "zero_action"
    gap = worse["overall"] - worse["overall_zero_action"]
    assert worse["overall_minus_baseline"] == pytest.approx(gap)


def test_seeds_are_one_row_with_their_spread(written: Written) -> None:
    for seed, more in enumerate((-0.03, 0.0, 0.06)):
        written(f"gated-seed{seed}", HARD + more, seed=seed, recipe="gated")
    reports = written("concat", HARD)
    concat, gated = read_experiments(reports)
    assert (gated.name, gated.seeds) == ("gated", (0, 1, 2))
    base = concat.error("executed").value
    np.testing.assert_allclose(
        gated.by_seed("executed"), base + np.array([-0.03, 0, 0.06]), atol=1e-5
    )
    # Their group errors are averaged before they are paired: what seeds do alike has no spread.
    apart = gated.minus(concat, "executed")
    assert (apart.value, apart.low, apart.high) == pytest.approx((0.01, 0.01, 0.01), abs=1e-5)
    table = experiment_table([concat, gated], "executed")
    assert [row[5] for row in table.rows[:2]] == [1, 3]
    assert [row[4] for row in table.rows[:2]] == [None, f"{base - 0.03:.3f} to {base + 0.06:.3f}"]
    file = experiment_csv([concat, gated])
    row = dict(zip(file.columns, file.rows[1], strict=True))
    assert row["seeds"] == "0 1 2"
    assert row["executed_seed_min"] == pytest.approx(base - 0.03, abs=1e-5)
    assert row["executed_seed_max"] == pytest.approx(base + 0.06, abs=1e-5)


def test_folds_are_one_evaluation_of_all_their_groups(written: Written) -> None:
    for seed in (0, 1):
        for fold in (2, 0, 1):
            places = slice(4 * fold, 4 * fold + 4)
            errors, name = HARD[places] + 0.1 * seed, f"few-seed{seed}-fold{fold}"
            written(name, errors, seed=seed, recipe="few", first=4 * fold)
    reports = written("whole", HARD)
    few, whole = read_experiments(reports)
    assert (few.name, few.seeds, few.folds, whole.folds) == ("few", (0, 1), 3, 1)
    assert few.groups == whole.groups
    for span, times in (("executed", 1), ("overall", 2)):
        base = whole.error(span).value
        np.testing.assert_allclose(few.by_seed(span), [base, base + 0.1 * times], rtol=1e-5)
        apart = few.minus(whole, span)
        # The groups are paired over all folds: the difference is the same in each.
        assert (apart.low, apart.high) == pytest.approx((0.05 * times, 0.05 * times), abs=1e-5)
    table = experiment_table([few, whole], "executed")
    shown = [[row[0], *row[5:7]] for row in table.rows[:2]]
    assert shown == [["few", 2, 3], ["whole", 1, 1]]
    file = experiment_csv([few, whole])
    assert [row[list(file.columns).index("folds")] for row in file.rows] == [3, 1]


def test_what_was_judged_on_other_ticks_is_refused(written: Written) -> None:
    """A fold that is missing, and tests that overlap, which are no folds."""
    written("few-fold0", HARD[:4], recipe="few")
    written("few-fold1", HARD[4:8], recipe="few", first=4)
    reports = written("whole", HARD)
    with pytest.raises(ConfigError, match=r"same test ticks(.|\n)*demo/08: null \(few\)"):
        read_experiments(reports)
    for name in ("few-fold1", "whole"):
        shutil.rmtree(reports / name)
    written("few-fold2", HARD[3:8], recipe="few", first=3)
    with pytest.raises(ConfigError, match="same test ticks"):
        read_experiments(reports)
