"""A training is never silent for long, and says how fast it goes and what it lacks."""

import csv
import sys
import time
from dataclasses import replace
from io import StringIO
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.store import FeatureStore, episode_name
from pipeline.train.batches import Prefetch, Windows
from pipeline.train.log import speed_file
from pipeline.train.progress import Progress, describe_data, peak_memory_bytes
from pipeline.train.run import policy_shape
from pipeline.train.split import Split
from pipeline.train.statistics import fit_normalization

CPU = torch.device("cpu")


WINDOWS = Windows(8, 65, 100, 0.1, 1.0)


class Waiting(Prefetch):
    """Stands for a feed."""

    def __init__(self) -> None:
        self.waited_s = 0.0


class Terminal(StringIO):
    """What is written to it, which says that it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch):
    """The time in s, which a test moves."""
    now = [1000.0]
    monkeypatch.setattr("pipeline.train.progress.time.perf_counter", lambda: now[0])
    return now


def test_without_a_terminal_a_line_a_minute(clock, capsys):
    with Progress(Waiting(), CPU, range(100, 200)) as progress:
        for _ in range(30):  # steps of 5 s, a reading every second one
            for _ in range(2):
                clock[0] += 5
                progress.advance()
            progress.show(progress.read(), 0.25, 1e-3)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[:2] == [
        "step 112 of 200: train loss 0.2500, 0.2 steps/s, about 7.3 min left",
        "step 124 of 200: train loss 0.2500, 0.2 steps/s, about 6.3 min left",
    ]


def test_on_a_terminal_a_bar_with_the_loss(store, params, trainer, clock, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr("pipeline.train.progress.EVERY_S", 0.0)
    trainer(store, params(max_steps=12, eval_every=12)).fit()
    shown = terminal.getvalue()
    assert "12/12" in shown
    assert "loss=" in shown.split("12/12")[0], "before the evaluation, too"
    assert "train loss" not in shown


def test_pauses_are_not_counted(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    feed = Waiting()
    progress = Progress(feed, CPU, range(10, 100), trained_s=50.0)
    now[0] += 4
    with progress.paused():
        now[0] += 1000
        assert progress.trained_s == 54
    now[0] += 1
    feed.waited_s = 2.0
    for _ in range(10):
        progress.advance()
    pace = progress.read()
    assert (pace.steps_per_s, pace.data_wait_share, pace.trained_s) == (2.0, 0.4, 55.0)
    now[0] += 10
    progress.advance()
    assert progress.read()[:2] == (0.1, 0.0)


def test_peak_memory_is_at_least_what_was_held():
    held = torch.ones(64 * 2**20 // 4)
    assert peak_memory_bytes(CPU) > held.nbytes


def test_the_log_has_speed_memory_and_time_over_all_starts(
    store, params, trainer, monkeypatch, capsys
):
    readings = count()  # every look at the clock takes a thousandth of a second
    monkeypatch.setattr("pipeline.train.progress.time.perf_counter", lambda: next(readings) / 1000)
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


def test_groups_that_were_cut_by_time_count_once(store, params):
    thirds = np.array_split(np.arange(30), 3)
    named = {episode_name(episode): episode_name(episode) for episode in store.episodes}
    shape = policy_shape(store, fit_normalization(store, thirds[0], WINDOWS))
    lines = describe_data(store, shape, params(), Split(*thirds, named, None))
    assert lines[1].endswith("of 1 + 1 + 1 groups (1 in all, cut by time)")
    assert not any("five folds" in line for line in lines), "one recording has no folds"


def test_one_test_group_of_several_is_too_few_for_an_interval(store, params):
    """Episodes of 30 ticks, each a group."""
    shape = policy_shape(store, fit_normalization(store, np.arange(30), WINDOWS))
    named = {episode_name(episode): episode_name(episode) for episode in store.episodes}
    few = Split(np.arange(30), np.arange(30, 60), np.arange(60, 90), named, None)
    more = replace(few, test=np.arange(60, 120))
    folds = params(split={"folds": 4})
    said = [
        "no interval; five folds test each" in "".join(describe_data(store, shape, *rest))
        for rest in ((params(), few), (params(), more), (folds, few))
    ]
    assert said == [True, False, False]


@pytest.fixture
def warnings(store, params):
    """`warnings(train, key=value, ...)`: of a training on these ticks, the others held out."""

    def found(train: np.ndarray, absent: dict[str, int] | None = None, **head: Any) -> list[str]:
        held_out = np.setdiff1d(np.arange(store.ticks), train)
        named = {episode_name(episode): episode_name(episode) for episode in store.episodes}
        shape = policy_shape(store, fit_normalization(store, train, WINDOWS))
        split = Split(train, held_out, held_out[:0], named, None)
        lines = describe_data(store, replace(shape, **(absent or {})), params(**head), split)
        return [line for line in lines if line.startswith("warning: ")]

    return found


def test_a_source_without_a_training_episode_is_named_with_the_way_out(warnings):
    """Episodes of 30 ticks: left, right, left, …"""
    (line,) = warnings(np.arange(30), split={"val": 0.4})
    assert line.startswith("warning: source 'right'")
    assert "train_head.split val 0.4 and test 0.15" in line
    assert warnings(np.arange(30), mixture={"right": 0.0}) == [], "the user wants it so"


def test_a_stream_that_no_training_episode_has_is_named(store, warnings):
    train, absent = np.arange(store.ticks), {"sensor_channels": 0}
    assert warnings(train) == []
    (line,) = warnings(train, absent)
    assert line.startswith("warning: sensor")
    assert "the training episodes' windows" in line and "train_head.split" in line
    assert warnings(train, absent, sensor_enabled=False) == []


def test_a_training_says_it_last_before_it_begins(tiny_store, trainer, params, tmp_path):
    """Of two recordings one is held out, and with it its source."""
    two = FeatureStore.open(tiny_store(tmp_path, episodes=2))
    *_, last = trainer(two, params()).summary()
    assert last.startswith("warning: source ")
