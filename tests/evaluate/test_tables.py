"""What is written and printed says what was scored."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import DiskFull
from pipeline.evaluate.tables import FOOTNOTE, error_text, metrics, write_tables
from pipeline.store import FeatureStore
from pipeline.train.predictions import BASELINES, Predictions
from pipeline.train.scores import Comparison

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
    assert document["rotation_deg"]["policy"] == pytest.approx(0.5)
    assert "relative" not in document["gripper"]
    assert document["overall"]["relative"] < 1
    # As many columns as `dvc metrics show` can put in a line.
    assert len(numbers(document)) == 2 + 2 + (2 + 2 + 1)
    assert all(number == float(f"{number:.6g}") for number in numbers(document))
    assert all(np.isfinite(numbers(document)))


def test_the_table_lines_up(comparison: Comparison) -> None:
    lines = error_text(comparison).splitlines()
    assert [line.split("  ")[0] for line in lines] == [
        "mean absolute error",
        "translation [mm]",
        "rotation [deg]",
        "gripper",
        "overall [training std]",
        FOOTNOTE,
    ]
    assert len({len(line) for line in lines[:-1]}) == 1
    assert lines[3].endswith("–")


def test_dimensions_that_hardly_move_are_said_below_the_table(comparison: Comparison) -> None:
    """Without them it may be that a baseline wins; `metrics.json` stays as it is."""
    names = tuple(f"joint_{index}" for index in range(5))
    scale = np.array([0.05, 0.06, 0.07, 1e-9, 0.0])
    still = replace(comparison, names=names, units=("",) * 5, scale=scale)
    moving = replace(still, scale=np.array([0.05, 0.06, 0.07, 0.0, 0.0]))
    error = f"{moving.overall('policy'):.3f}, {moving.relative():.2f} times the best baseline's"
    best = min(BASELINES, key=moving.overall).replace("_action", "").replace("_", " ")
    *_, footnote, line = error_text(still).splitlines()
    assert footnote == FOOTNOTE
    assert line == (
        "hardly moving: joint_3 (training std at most 1e-09, where 0.07 is usual for such "
        "dimensions), 1 of the 4 dimensions in the overall error; without, it is "
        f"{error} ({best})"
    )
    assert metrics(still)["overall"]["policy"] == pytest.approx(still.overall("policy"), rel=1e-5)
    assert moving.overall("policy") < 0.01 * still.overall("policy")


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
    groups = {row["group"]: row for row in rows["errors"]}
    assert list(groups) == ["translation", "rotation", "gripper", "overall"]
    assert float(groups["rotation"]["policy_rmse"]) == pytest.approx(0.5)
    assert float(groups["overall"]["repeat_last"]) == pytest.approx(
        comparison.overall("repeat_last"), rel=1e-5
    )
    assert rows["modalities"] == rows["streams"] == [], "headings alone, for nobody asked"
    assert [len(rows[name]) for name in ("dimensions", "horizon", "episodes", "predictions")] == [
        5,
        4 * 5,
        2 * 3,
        60,
    ]
    assert float(rows["dimensions"][3]["policy_mae"]) == pytest.approx(0.5)
    assert float(rows["horizon"][6]["policy"]) == pytest.approx(0.2)
    assert rows["horizon"][6]["dimension"] == "dy"
    steps = [float(row["policy"]) for row in rows["steps"]]
    assert [row["steps_ahead"] for row in rows["steps"]] == ["0", "1", "2", "3"]
    assert np.mean(steps) == pytest.approx(comparison.overall("policy"), rel=0.02)
    assert rows["episodes"][0]["episode"] == "episode_001"
    assert rows["episodes"][0]["source"] == "right"
    tick = rows["predictions"][31]
    assert tick["episode"] == "episode_002"
    assert float(tick["time_s"]) == pytest.approx(0.1)
    assert float(tick["dx_predicted"]) - float(tick["dx_recorded"]) == pytest.approx(0.1, abs=1e-5)


def test_a_number_that_is_none_is_not_left_out(comparison: Comparison) -> None:
    comparison.scores["policy"].mae[0] = np.nan
    assert np.isnan(metrics(comparison)["translation_mm"]["policy"])


def test_a_step_no_chunk_reaches_is_empty(
    recorded: Callable[..., Predictions],
    compared: Callable[[Predictions], Comparison],
    store: FeatureStore,
    tmp_path: Path,
) -> None:
    predictions = recorded(np.array([28, 58]))
    write_tables(tmp_path, compared(predictions), predictions, store)
    lines = (tmp_path / "steps.csv").read_text().splitlines()
    assert lines[3:] == ["2,,,,", "3,,,,"] and ",," not in lines[2]


def test_what_a_report_is_linked_to_is_not_written(
    comparison: Comparison, predictions: Predictions, store: FeatureStore, tmp_path: Path
) -> None:
    """As DVC restores an output: every file a link into its cache."""
    report, cache = tmp_path / "report", tmp_path / "cache"
    report.mkdir()
    cache.mkdir()
    for name in ("metrics.json", "dimensions.csv", "horizon.csv", "episodes.csv"):
        (cache / name).write_text("as it was")
        (report / name).hardlink_to(cache / name)
    write_tables(report, comparison, predictions, store)
    assert {file.read_text() for file in cache.iterdir()} == {"as it was"}
    assert json.loads((report / "metrics.json").read_text()) == metrics(comparison)


def test_a_full_disk_is_named(
    comparison: Comparison, predictions: Predictions, store: FeatureStore, monkeypatch, tmp_path
) -> None:
    def full(path: Path, *rest: object, **named: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(DiskFull, match=str(tmp_path)):
        write_tables(tmp_path, comparison, predictions, store)
