"""The stopwatch of a training counts training."""

import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.store import FeatureStore
from pipeline.train.log import speed_file
from pipeline.train.progress import Speed, peak_memory_bytes

Make = Callable[..., Any]
CPU = torch.device("cpu")


class Waiting:
    """Stands for a feed."""

    waited_s = 0.0


def test_pauses_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    feed = Waiting()
    speed = Speed(feed, CPU, step=10, trained_s=50.0)  # type: ignore[arg-type]
    now[0] += 4
    with speed.paused():
        now[0] += 1000
        assert speed.trained_s == 54
    now[0] += 1
    feed.waited_s = 2.0
    pace = speed.read(20)
    assert (pace.steps_per_s, pace.data_wait_share, pace.trained_s) == (2.0, 0.4, 55.0)
    now[0] += 10
    assert speed.read(25)[:2] == (0.5, 0.0)


def test_peak_memory_is_at_least_what_was_held() -> None:
    held = torch.ones(64 * 2**20 // 4)
    assert peak_memory_bytes(CPU) > held.nbytes


def test_the_log_has_speed_memory_and_time_over_all_starts(
    store: FeatureStore,
    params: Make,
    trainer: Make,
    capsys: pytest.CaptureFixture[str],
) -> None:
    begun = trainer(store, params(max_steps=30))
    begun._trained_s = 1000.0
    begun.fit()
    with speed_file(Path(params().logs)).open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    assert [row["step"] for row in rows] == ["10", "20", "30"]
    seconds = [float(row["trained_s"]) for row in rows]
    assert 1000 < seconds[0] < seconds[1] < seconds[2] < 1060
    assert all(float(row["peak_memory_mib"]) > 50 for row in rows)
    assert all(float(row["steps_per_s"]) > 0 for row in rows)
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.startswith("trained 30 steps in 16.7 min (0.0 steps/s)")
    assert "steps/s), peak memory" in said
    assert said.endswith((" MiB", " GiB"))
