"""Folds hold whole recordings; scores are those of scikit-learn's ridge regression on the rows."""

import numpy as np
import pytest

from pipeline.base.errors import NumericsError, StoreMismatch
from pipeline.evaluate.figures import Figure
from pipeline.evaluate.probe.ridge import ProbeFolds, cross_validate, estimate, fold_by_recording
from pipeline.store import FeatureStore
from tests.evaluate.probe.conftest import nested, r2_by_fold


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
    fewer = fold_by_recording(store, 5, 8, max_ticks=20)
    assert len(fewer.ticks) == 20 and set(fewer.ticks // 30) == set(range(6))


def test_fewer_recordings_and_ticks_are_fewer_folds(tiny_store, tmp_path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=3))
    folds = fold_by_recording(store, 5, 8)
    assert folds.count == 3 and "3 recordings make 3 folds, not 5" in folds.notes
    folds = fold_by_recording(store, 5, 8, max_ticks=2)
    assert (folds.count, folds.recordings, len(folds.ticks)) == (2, 2, 2)
    with pytest.raises(StoreMismatch, match=r"found 1\..* more probe\.max_ticks"):
        fold_by_recording(store, 5, 8, max_ticks=1)
    with pytest.raises(StoreMismatch, match=r"found 0.*shorter probe.horizon"):
        fold_by_recording(store, 5, 31)


def test_deals_differ_and_each_holds_every_recording_out_once(tiny_store, tmp_path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=12))
    folds = fold_by_recording(store, 3, 8, repeats=4)
    assert folds.deals.shape == (4, 12)
    assert len(np.unique(folds.deals, axis=0)) == 4
    assert len(set(zip(folds.group.tolist(), (folds.ticks // 30).tolist(), strict=True))) == 12
    for deal in folds.deals:
        assert np.bincount(deal).tolist() == [4, 4, 4]
    again = fold_by_recording(store, 3, 8, repeats=4)
    np.testing.assert_array_equal(again.deals, folds.deals)


PENALTIES = (1e-3, 1e-1, 1.0, 30.0)
Rows = tuple[np.ndarray, np.ndarray, ProbeFolds]


@pytest.fixture
def rows() -> Rows:
    """Inputs (one of which never varies), targets (one of which never varies), two deals."""
    rng = np.random.default_rng(0)
    x = rng.normal(0.3, 1, (200, 7))
    x[:, 5] = x[:, 0] + 1e-3 * rng.normal(size=200)
    x[:, 6] = 0.0
    y = x[:, :3] @ rng.normal(size=(3, 4)) + rng.normal(size=(200, 4)) * [0.1, 1, 3, 0.5]
    y[:, 3] = 0.0
    group = rng.integers(0, 12, 200)
    deals = np.array([np.arange(12) % 4, np.arange(12) // 3])
    return x, y, ProbeFolds(np.arange(200), group, deals, ())


def test_scores_and_penalties_are_those_of_rows(rows: Rows) -> None:
    x, y, folds = rows
    score = cross_validate(x, y, folds, PENALTIES)
    means = []
    for repeat, fold in enumerate(folds.fold):
        r2, chosen = nested(x, y, fold, PENALTIES)
        found = r2_by_fold(score, folds, repeat)
        np.testing.assert_allclose(found[:, :3], r2[:, :3], atol=1e-8)
        assert np.isnan(found[:, 3]).all()
        np.testing.assert_array_equal(score.penalties[repeat], chosen)
        means.append((r2[:, :3] * np.bincount(fold)[:, None]).sum(0) / len(fold))
    assert score.rows.tolist() == np.bincount(folds.group).tolist()
    assert score.mean == pytest.approx(np.mean(means), abs=1e-8)


def test_each_known_block_keeps_its_own_penalties(rows: Rows) -> None:
    x, y, folds = rows
    of_known = np.array([[1e-2, 1.0, 1.0, 30.0], [3.0, 1e-3, 0.1, 1.0]])
    known = [(x[:, [0]], of_known), (x[:, [3, 4]], 2 * of_known)]
    score = cross_validate(x[:, [1, 2]], y, folds, PENALTIES, known)
    # One penalty for all that is known is the same, with the second block in other units.
    x = np.hstack([x[:, [1, 2, 0]], x[:, [3, 4]] / np.sqrt(2)])
    for repeat, fold in enumerate(folds.fold):
        r2, chosen = nested(x, y, fold, PENALTIES, 3, of_known[repeat])
        found = r2_by_fold(score, folds, repeat)
        np.testing.assert_allclose(found[:, :3], r2[:, :3], atol=1e-8)
        np.testing.assert_array_equal(score.penalties[repeat], chosen)


def test_a_penalty_below_rounding_is_refused(rows: Rows) -> None:
    x, y, folds = rows
    with pytest.raises(NumericsError, match="one is too small for 14 inputs"):
        cross_validate(np.hstack([x, x]), y, folds, (1e-300,))


def test_an_interval_covers_recordings_and_deals() -> None:
    """What differs by recording widens it, and so does what differs by deal."""
    rng = np.random.default_rng(0)
    rows = np.full(40, 25.0)
    by_recording = 25 * rng.normal(0.5, 0.2, (1, 40))
    value, low, high = vars(estimate(by_recording, rows)).values()
    error = by_recording.std() / 25 / np.sqrt(40)
    assert value == pytest.approx(by_recording.mean() / 25)
    assert (high - low) / 2 == pytest.approx(1.96 * error, rel=0.1)
    deals = by_recording + 25 * np.array([[-0.3], [0.0], [0.3]])
    again = estimate(deals, rows)
    assert again.value == pytest.approx(value)
    assert again.low == pytest.approx(value - 0.3 - 1.5 * error, abs=0.02)
    assert again.high == pytest.approx(value + 0.3 + 1.5 * error, abs=0.02)


def test_a_gain_is_paired_by_recording(rows: Rows) -> None:
    x, y, folds = rows
    known = cross_validate(x[:, [0]], y, folds, PENALTIES)
    both = cross_validate(x[:, [0, 1]], y, folds, PENALTIES)
    gain = both.gain(known)
    assert gain.value == pytest.approx(both.mean - known.mean)
    assert 0 < gain.low < gain.value < gain.high
    assert known.gain(known) == Figure(0, 0, 0)
