"""Rows on their way: equal ones once, commits behind the model, and what a report says of it."""

import threading

import numpy as np
import pytest

from pipeline.base.errors import DiskFull
from pipeline.extract.engine import in_background
from pipeline.extract.rows import RowPreparation
from pipeline.store import FeatureStore, StoreBuild
from pipeline.vlm.qwen import FrozenVLM
from tests.extract.conftest import run


class TestEqualRows:
    def test_are_computed_once_and_the_store_is_the_same(
        self, params, changed, recordings, counted, stand_still, monkeypatch
    ):
        for episode in ("episode_1", "episode_2"):
            stand_still(recordings / "Touch_dot" / episode)
        report = run(params)[0]
        store = FeatureStore.open(params.extract.store)
        keys = [bytes(key) for key in store.array("vl/key")]
        assert len(set(keys)) < len(keys) - 10
        assert sum(counted) == report.computed == len(set(keys))
        assert report.repeated == len(keys) - len(set(keys))
        other = changed(extract={"store": str(params.extract.store.with_name("each.zarr"))})
        prepare = RowPreparation.prepare
        monkeypatch.setattr(
            RowPreparation, "prepare", lambda self, rows, firsts: prepare(self, rows, None)
        )
        assert run(other)[0].computed == len(keys)
        each = FeatureStore.open(other.extract.store)
        assert [bytes(key) for key in each.array("vl/key")] == keys
        assert np.allclose(store.array("vl/features"), each.array("vl/features"), atol=2e-5)
        assert store.attrs["environment"] == each.attrs["environment"]

    def test_go_on_after_a_kill(self, params, recordings, stand_still, interrupted):
        stand_still(recordings / "Touch_dot" / "episode_2")
        interrupted(params, 1)
        report = run(params)[0]
        assert report.taken == 0
        assert report.computed + report.repeated == report.rows - params.extract.batch_size


class TestCommits:
    def test_run_beside_the_model_in_order_on_one_thread(self, params, monkeypatch):
        real, threads, rows = StoreBuild.mark, set(), []

        def mark(self, numbers, *rest):
            threads.add(threading.current_thread().name)
            rows.extend(numbers)
            real(self, numbers, *rest)

        monkeypatch.setattr(StoreBuild, "mark", mark)
        report = run(params)[0]
        assert len(threads) == 1
        assert threads.pop().startswith("commit")
        assert sorted(rows) == list(range(report.rows))

    def test_a_failure_stops_the_model_at_once(self, params, counted, monkeypatch):
        def mark(self, *args):
            raise DiskFull("no room at all")

        monkeypatch.setattr(StoreBuild, "mark", mark)
        with pytest.raises(DiskFull, match="no room at all"):
            run(params)[0]
        assert len(counted) <= 4
        assert not [one for one in threading.enumerate() if one.name.startswith("commit")]

    def test_what_is_computed_is_kept_when_the_model_fails(self, params, monkeypatch):
        real, calls = FrozenVLM.submit, []

        def submit(self, batch):
            calls.append(len(batch))
            if len(calls) == 4:
                raise RuntimeError("the device fell off the bus")
            return real(self, batch)

        with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="fell off"):
            patch.setattr(FrozenVLM, "submit", submit)
            run(params)[0]
        report = run(params)[0]
        assert report.computed == report.rows - sum(calls[:3])


def test_the_report_says_how_the_time_was_spent(params):
    _, model, waited = run(params)[0].speed
    assert 0 < model <= 1
    assert 0 <= waited < 1
    assert model + waited <= 1


def test_pieces_are_made_in_order_as_far_ahead_as_is_asked():
    begun, ahead = [], [0]

    def make(piece: int) -> int:
        begun.append(piece)
        return -piece

    made = in_background(range(1, 21), make, 2, lambda: ahead[0])
    assert next(made) == -1
    assert len(begun) <= 3
    ahead[0] = 9
    assert next(made) == -2
    ahead[0] = 0  # as when the batch size settles on a smaller one
    assert list(made) == [-piece for piece in range(3, 21)]
    assert sorted(begun) == list(range(1, 21))
    assert not [one for one in threading.enumerate() if one.name.startswith("decode")]
