"""A training is never silent for long, and says how fast it goes and what it lacks."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.store import episode_name
from pipeline.train.batches import Windows
from pipeline.train.progress import Progress, describe_data, peak_memory_bytes
from pipeline.train.run import policy_shape
from pipeline.train.split import Split
from pipeline.train.statistics import fit_normalization

CPU = torch.device("cpu")


WINDOWS = Windows(8, 65, 100, 0.1, 1.0)


@pytest.fixture
def feed() -> Any:
    """As much of a feed as is looked at."""
    return SimpleNamespace(waited_s=0.0)


@pytest.fixture
def clock(monkeypatch):
    """The time in s, which a test moves."""
    now = [1000.0]
    monkeypatch.setattr("pipeline.train.progress.time.perf_counter", lambda: now[0])
    return now


def test_without_a_terminal_a_line_a_minute(feed, clock, capsys):
    with Progress(feed, CPU, range(100, 200)) as progress:
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


def test_pauses_are_not_counted(feed, clock, monkeypatch, capsys):
    monkeypatch.setattr("pipeline.train.progress.EVERY_S", 1.0)
    progress = Progress(feed, CPU, range(10, 100), trained_s=50.0)
    clock[0] += 4
    with progress.paused():
        clock[0] += 1000
        assert progress.trained_s == 54
    clock[0] += 1
    feed.waited_s = 2.0
    for _ in range(10):
        progress.advance()
    progress.show(0.5, 1e-3)
    assert progress.trained_s == 55.0
    assert "2 steps/s" in capsys.readouterr().err


def test_peak_memory_is_at_least_what_was_held():
    held = torch.ones(64 * 2**20 // 4)
    assert peak_memory_bytes(CPU) > held.nbytes


@pytest.fixture
def described(store, params):
    """`described(train, key=value, ...)`: the lines on these training ticks, all others val."""

    def lines(train: np.ndarray, absent: dict[str, int] | None = None, **head: Any) -> list[str]:
        held_out = np.setdiff1d(np.arange(store.ticks), train)
        named = {episode_name(episode): episode_name(episode) for episode in store.episodes}
        shape = policy_shape(store, fit_normalization(store, train, WINDOWS))
        split = Split(train, held_out, held_out[:0], named, None)
        return describe_data(store, replace(shape, **(absent or {})), params(**head), split)

    return lines


def warned(lines: list[str]) -> list[str]:
    return [line for line in lines if line.startswith("warning: ")]


def test_groups_that_were_cut_by_time_count_once(described):
    line = described(np.arange(10))[1]
    assert line.endswith("of 1 + 6 + 0 groups (6 in all, cut by time)")


def test_a_lossy_store_is_named_with_the_proof(store, described, monkeypatch):
    train = np.arange(store.ticks)
    assert not any("stored in" in line for line in described(train))
    loss = {"of": "mean", "slots": "x", "r2": -0.01, "low": -0.02, "high": 0.005}
    loss["error_std"] = 0.1
    proof = {"store": "whole.zarr", "recordings": 24, "ticks": 90, "losses": [loss]}
    plain, spec = store.attrs, store.spec
    found = "found that the R2 of the features alone changes by -0.0100 (-0."
    for dtype, more, said in (
        ("int8", {}, "stages.probe with probe.codecs on a store in float32"),
        ("float16", {"proof": proof}, f"a probe of 24 recordings of whole.zarr {found}"),
    ):
        lossy = {"feature_spec": spec | {"storage_dtype": dtype}}
        monkeypatch.setattr(store, "attrs", {**plain, **lossy, **more})
        assert any(f"features are stored in {dtype}; {said}" in line for line in described(train))


def test_a_source_without_a_training_episode_is_named_with_the_way_out(described):
    """Episodes of 30 ticks: left, right, left, …"""
    (line,) = warned(described(np.arange(30), split={"val": 0.4}))
    assert line.startswith("warning: source 'right'")
    assert "train_head.split val 0.4 and test 0.15" in line
    assert warned(described(np.arange(30), mixture={"right": 0.0})) == [], "the user wants it so"


def test_a_stream_that_no_training_episode_has_is_named(store, described):
    train, absent = np.arange(store.ticks), {"sensor_channels": 0}
    assert warned(described(train)) == []
    (line,) = warned(described(train, absent))
    assert line.startswith("warning: sensor")
    assert "the training episodes' windows" in line and "train_head.split" in line
    assert warned(described(train, absent, sensor_enabled=False)) == []
