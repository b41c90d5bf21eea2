"""Folds hold whole recordings, and no chunk that is not whole."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import StoreMismatch
from pipeline.evaluate.probe.ridge import fold_by_recording
from pipeline.store import FeatureStore

Make = Callable[..., Any]


def test_each_recording_is_in_one_fold_with_its_other_formats(store: FeatureStore) -> None:
    store.array("vl/key")[40] = store.array("vl/key")[10]  # episode 4 is episode 1
    folds = fold_by_recording(store, 5, 8)
    episode = folds.ticks // 30
    of = {int(one): set(folds.fold[0, episode == one].tolist()) for one in np.unique(episode)}
    assert all(len(several) == 1 for several in of.values())
    assert of[1] == of[4]
    assert folds.count == len(set.union(*of.values())) == 5
    assert folds.recordings == 5
    left_out, merged = folds.notes
    assert "last 7 ticks of each episode" in left_out
    assert "6 episodes make 5 recordings" in merged
    assert not fold_by_recording(store, 3, 1).notes[1:]


def test_chunks_end_within_their_episode(store: FeatureStore) -> None:
    folds = fold_by_recording(store, 3, 8)
    assert (folds.ticks % 30 <= 22).all()
    assert len(folds.ticks) == 6 * 23
    assert len(fold_by_recording(store, 6, 8, repeats=5).deals) == 1, "all folds are alike"


def test_fewer_recordings_are_fewer_folds_and_it_is_said(tiny_store: Make, tmp_path: Path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=3))
    folds = fold_by_recording(store, 5, 8)
    assert folds.count == 3
    assert folds.notes[1:] == ("3 recordings make 3 folds, not 5",)


def test_one_recording_is_refused(tiny_store: Make, tmp_path: Path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=1))
    with pytest.raises(StoreMismatch, match=r"at least two recordings .* found 1"):
        fold_by_recording(store, 5, 8)


def test_recordings_shorter_than_the_chunk_do_not_count(store: FeatureStore) -> None:
    with pytest.raises(StoreMismatch, match=r"found 0.*shorter probe.horizon"):
        fold_by_recording(store, 5, 31)


def test_a_limit_takes_ticks_evenly(store: FeatureStore) -> None:
    folds = fold_by_recording(store, 5, 8, max_ticks=20)
    assert len(folds.ticks) == 20
    assert set(folds.ticks // 30) == set(range(6))
    assert folds.notes[1:] == ("20 of the ticks are read, evenly spread (probe.max_ticks)",)


def test_few_ticks_leave_fewer_recordings_and_folds(store: FeatureStore) -> None:
    folds = fold_by_recording(store, 5, 8, max_ticks=4)
    assert (folds.count, folds.recordings, len(folds.ticks)) == (4, 4, 4)
    with pytest.raises(StoreMismatch, match=r"found 1\..* more probe\.max_ticks"):
        fold_by_recording(store, 5, 8, max_ticks=1)


def test_deals_differ_and_each_holds_every_recording_out_once(
    tiny_store: Make, tmp_path: Path
) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=12))
    folds = fold_by_recording(store, 3, 8, repeats=4)
    assert folds.deals.shape == (4, 12)
    assert len(np.unique(folds.deals, axis=0)) == 4
    assert len(set(zip(folds.group.tolist(), (folds.ticks // 30).tolist(), strict=True))) == 12
    for deal in folds.deals:
        assert np.bincount(deal).tolist() == [4, 4, 4]
    again = fold_by_recording(store, 3, 8, repeats=4)
    np.testing.assert_array_equal(again.deals, folds.deals)


def test_many_recordings_are_dealt_in_parts(tiny_store: Make, tmp_path: Path) -> None:
    """So that time and memory do not grow with them."""
    store = FeatureStore.open(tiny_store(tmp_path, episodes=40))
    folds = fold_by_recording(store, 2, 8, repeats=9)
    assert np.unique(folds.deals, axis=1).shape[1] <= 8
    assert (np.abs(folds.fold.mean(axis=1) - 0.5) < 0.05).all()
