"""What is written and printed says what was scored."""

import csv
import json
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.evaluate.baselines import BASELINES, METHODS
from pipeline.evaluate.figures import NO_INTERVAL, Figure
from pipeline.evaluate.tables import error_table, error_text, metrics, write_tables
from pipeline.train.predictions import Predictions
from pipeline.train.scores import Comparison, compare

TICKS = np.arange(30, 90)


@pytest.fixture
def predictions(recorded: Callable[..., Predictions]) -> Predictions:
    return recorded(TICKS, error=np.array([0.1, 0.2, 0.3, 0.5, 0.0]))


@pytest.fixture
def comparison(predictions: Predictions, compared) -> Comparison:
    return compared(predictions)


def numbers(document: dict[str, Any]) -> list[float]:
    return [
        number
        for value in document.values()
        for number in (numbers(value) if isinstance(value, dict) else [value])
    ]


def test_the_metrics_are_numbers_only_the_executed_first(comparison: Comparison) -> None:
    document = metrics(comparison)
    assert list(document) == ["test", "executed", "chunk"]
    assert document["test"] == {"episodes": 2, "groups": 2, "ticks": 60}
    assert document["chunk"]["translation_mm"]["policy"]["value"] == pytest.approx(0.2)
    assert document["executed"]["rotation_deg"]["policy"]["value"] == pytest.approx(0.5)
    assert list(document["executed"]["gripper"]) == ["policy"], "it never varies"
    overall = document["chunk"]["overall"]
    assert overall["difference"]["value"] < 0
    assert overall["policy"]["low"] <= overall["policy"]["value"] <= overall["policy"]["high"]
    found = sum(overall[name]["value"] for name in ("best_baseline", "difference"))
    assert found == pytest.approx(overall["policy"]["value"], rel=1e-4)
    assert all(number == float(f"{number:.6g}") for number in numbers(document))
    assert all(np.isfinite(numbers(document)))


def test_samples_and_phases_are_there_where_they_are_known(predictions, comparison):
    phases = np.where(TICKS < 60, "approach", "hold")
    others = {
        name: np.zeros((60, 4, 5), np.float32) for name in (*BASELINES, "mean of n", "best of n")
    }
    action = (comparison.names, comparison.units, comparison.groups, comparison.scale)
    found = compare(predictions, others, action, (TICKS % 5).astype(np.str_), phases)
    document = metrics(found, Figure(0.3, 0.2, 0.4))
    assert list(document["samples"]) == ["one", "mean_of_n", "best_of_n", "energy_score"]
    assert document["samples"]["energy_score"] == {"value": 0.3, "low": 0.2, "high": 0.4}
    assert [part["ticks"] for part in document["phases"].values()] == [30, 30]
    text = error_text(found, Figure(0.3, 0.2, 0.4))
    assert "energy score 0.300 (0.200–0.400)" in text and re.search(r"\napproach .* 30\n", text)
    assert "by phase" not in error_text(comparison)


def test_the_text_has_both_tables_and_the_verdicts(comparison: Comparison) -> None:
    text = error_text(comparison)
    for part in (comparison.executed, comparison):
        assert "\n".join(error_table(part).text()) in text
    assert text.splitlines()[-1].count("resolved better") == 2


def test_of_one_group_it_is_said_that_there_is_no_interval(recorded, compared):
    assert NO_INTERVAL in error_text(compared(recorded(np.arange(30, 60), 0.1)))


def test_files_hold_every_dimension_step_episode_and_tick(comparison, predictions, store, tmp_path):
    parts = {"comparison": comparison, "predictions": predictions, "store": store}
    files = write_tables(tmp_path, SimpleNamespace(**parts, study=None, energy=None))
    assert sorted(file.name for file in files) == sorted(file.name for file in tmp_path.iterdir())
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics(comparison)
    rows = {
        file.stem: list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))
        for file in files
        if file.suffix == ".csv"
    }
    groups = {row["group"]: row for row in rows["errors"]}
    assert list(groups) == ["translation", "rotation", "gripper", "overall"]
    assert float(groups["rotation"]["policy"]) == pytest.approx(0.5)
    low, high = (float(groups["overall"][f"zero_action_{end}"]) for end in ("low", "high"))
    assert low <= float(groups["overall"]["zero_action"]) <= high
    assert list(rows["executed"][0]) == list(rows["errors"][0])
    group, other = rows["groups"]
    assert (group["group"], other["group"]) == ("1", "2")
    assert (group["executed_entries"], group["overall_entries"]) == ("30", "114")
    mean = (float(group["repeat_last_overall"]) + float(other["repeat_last_overall"])) / 2
    assert mean == pytest.approx(comparison.overall("repeat_last"), rel=1e-5)
    assert {f"{way}_executed" for way in METHODS} < group.keys()
    assert float(groups["overall"]["repeat_last"]) == pytest.approx(
        comparison.overall("repeat_last"), rel=1e-5
    )
    assert rows["streams"] == [], "headings alone, for nobody asked"
    assert [len(rows[name]) for name in ("dimensions", "episodes", "predictions")] == [5, 6, 60]
    assert float(rows["dimensions"][3]["policy"]) == pytest.approx(0.5)
    steps = [float(row["policy"]) for row in rows["steps"]]
    assert [row["steps_ahead"] for row in rows["steps"]] == ["0", "1", "2", "3"]
    assert np.mean(steps) == pytest.approx(comparison.overall("policy"), rel=0.02)
    assert rows["episodes"][0]["episode"] == "episode_001"
    assert rows["episodes"][0]["source"] == "right"
    tick = rows["predictions"][31]
    assert tick["episode"] == "episode_002"
    assert float(tick["time_s"]) == pytest.approx(0.1)
    assert float(tick["dx_predicted"]) - float(tick["dx_recorded"]) == pytest.approx(0.1, abs=1e-5)
