"""What is written and printed says what was scored."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.evaluation import Comparison, Predictions, metrics, table, write_tables
from pipeline.store import FeatureStore

TICKS = np.arange(30, 90)


@pytest.fixture
def predictions(recorded: Callable[..., Predictions]) -> Predictions:
    return recorded(TICKS, error=np.array([0.1, 0.2, 0.3, 0.5, 0.0]))


@pytest.fixture
def comparison(
    predictions: Predictions, compared: Callable[[Predictions], Comparison]
) -> Comparison:
    return compared(predictions)


def numbers(document: dict[str, Any]) -> list[float]:
    return [
        number
        for value in document.values()
        for number in (numbers(value) if isinstance(value, dict) else [value])
    ]


def test_the_metrics_are_few_and_numbers_only(comparison: Comparison) -> None:
    document = metrics(comparison)
    assert document["held_out"] == {"episodes": 2, "ticks": 60}
    assert document["translation_mm"]["policy"] == pytest.approx(0.2)
    assert document["rotation_deg"]["policy_rmse"] == pytest.approx(0.5)
    assert document["dimension"]["dz_mm"] == pytest.approx(0.3)
    assert "relative" not in document["gripper"]
    assert document["overall"]["relative"] < 1
    assert len(numbers(document)) <= 40
    assert all(np.isfinite(numbers(document)))


def test_the_table_lines_up(comparison: Comparison) -> None:
    lines = table(comparison).splitlines()
    assert [line.split("  ")[0] for line in lines] == [
        "mean absolute error",
        "translation [mm]",
        "rotation [deg]",
        "gripper",
        "overall [training std]",
    ]
    assert len({len(line) for line in lines}) == 1
    assert lines[3].endswith("-")


def test_files_hold_every_dimension_step_episode_and_tick(
    comparison: Comparison, predictions: Predictions, store: FeatureStore, tmp_path: Path
) -> None:
    files = write_tables(tmp_path, comparison, predictions, store)
    assert sorted(file.name for file in files) == sorted(file.name for file in tmp_path.iterdir())
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics(comparison)
    rows = {
        file.stem: list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))
        for file in files
        if file.suffix == ".csv"
    }
    assert [len(rows[name]) for name in ("dimensions", "horizon", "episodes", "predictions")] == [
        5,
        4 * 5,
        2 * 3,
        60,
    ]
    assert float(rows["dimensions"][3]["policy_mae"]) == pytest.approx(0.5)
    assert float(rows["horizon"][6]["policy"]) == pytest.approx(0.2)
    assert rows["horizon"][6]["dimension"] == "dy"
    assert rows["episodes"][0]["episode"] == "episode_001"
    assert rows["episodes"][0]["source"] == "right"
    tick = rows["predictions"][31]
    assert tick["episode"] == "episode_002"
    assert float(tick["time_s"]) == pytest.approx(0.1)
    assert float(tick["dx_predicted"]) - float(tick["dx_recorded"]) == pytest.approx(0.1, abs=1e-5)
