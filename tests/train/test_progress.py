"""A training is never silent for long, and says how fast it goes and what it lacks."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.store import episode_name
from pipeline.train.batches import Prefetch, Windows
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
            progress.show(0.25, 1e-3)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[:2] == [
        "step 112 of 200: train loss 0.2500, 0.2 steps/s, about 7.3 min left",
        "step 124 of 200: train loss 0.2500, 0.2 steps/s, about 6.3 min left",
    ]


def test_pauses_are_not_counted(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr("pipeline.train.progress.EVERY_S", 1.0)
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
    progress.show(0.5, 1e-3)
    assert progress.trained_s == 55.0
    assert "2 steps/s" in capsys.readouterr().err


def test_peak_memory_is_at_least_what_was_held():
    held = torch.ones(64 * 2**20 // 4)
    assert peak_memory_bytes(CPU) > held.nbytes


def test_groups_that_were_cut_by_time_count_once(store, params):
    thirds = np.array_split(np.arange(30), 3)
    named = {episode_name(episode): episode_name(episode) for episode in store.episodes}
    shape = policy_shape(store, fit_normalization(store, thirds[0], WINDOWS))
    lines = describe_data(store, shape, params(), Split(*thirds, named, None))
    assert lines[1].endswith("of 1 + 1 + 1 groups (1 in all, cut by time)")


def test_a_lossy_store_is_named_with_the_proof(store, params, monkeypatch):
    train = np.arange(store.ticks)
    shape = policy_shape(store, fit_normalization(store, train, WINDOWS))
    named = {episode_name(episode): episode_name(episode) for episode in store.episodes}
    split = Split(train, train[:0], train[:0], named, None)
    assert not any("stored in" in line for line in describe_data(store, shape, params(), split))
    loss = {"of": "mean", "slots": "x", "r2": -0.01, "low": -0.02, "high": 0.005}
    loss["error_std"] = 0.1
    proof = {"store": "whole.zarr", "recordings": 24, "ticks": 90, "losses": [loss]}
    plain, spec = store.attrs, store.spec
    for dtype, more, said in (
        ("int8", {}, "stages.probe with probe.codecs on a store in float32"),
        ("float16", {}, "stages.probe with probe.codecs on a store in float32"),
        ("float16", {"proof": proof}, "a probe of 24 recordings of whole.zarr found -0.0100 (-0."),
    ):
        lossy = {"feature_spec": spec | {"storage_dtype": dtype}}
        monkeypatch.setattr(store, "attrs", {**plain, **lossy, **more})
        lines = describe_data(store, shape, params(), split)
        assert any(f"features are stored in {dtype}; {said}" in line for line in lines)


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
