"""The slot that carries the action is found, and nothing that only looks as if it did."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import ProbeParams
from pipeline.base.errors import ConfigError, NumericsError
from pipeline.evaluate.probe.inputs import SlotName
from pipeline.evaluate.probe.ridge import ProbeFolds, ProbeScore
from pipeline.evaluate.probe.study import Known, ProbeResult, ProbeStudy, probe, ranked, recommend
from pipeline.evaluate.probe.tables import advice, metrics, table
from pipeline.store import FeatureStore
from tests.evaluate.probe.conftest import limited, nested, r2_by_fold, renamed

Make = Callable[..., Any]

PENALTIES = (1e-3, 1e-1, 1.0, 10.0)


def probed(store: FeatureStore, **changed: Any) -> ProbeStudy:
    """With small windows and chunks."""
    small = {"horizon": 2, "sensor_window": 4, "state_window": 4, "penalties": PENALTIES}
    return probe(store, ProbeParams.model_validate(small | changed))


def test_the_slot_that_carries_the_action_is_first(tiny_store: Make, tmp_path: Path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=24, slots=5))
    rows = store.array("tick/vl_row")
    features = store.array("vl/features")
    weights = np.random.default_rng(1).normal(size=(8, 4)).astype(np.float32)
    store.array("tick/action")[:, :4] = features[rows, 3] @ weights
    study = probed(store, horizon=1)
    first, *others = ranked(study.slots)
    assert first.slots == (3,)
    assert first.alone.mean > 0.99
    # Ticks share a VL row, and so an action: the one before tells two of three.
    past, *_ = study.known
    assert past.name == "past actions"
    assert 0.2 < past.score.mean < 0.8
    assert study.gain(first).value > 0.99 - study.baseline.score.mean - 0.05
    assert (study.gain(first).low or 0) > 0.2
    for other in others:
        assert abs(other.alone.mean) < 0.1


def test_a_codec_is_judged_by_its_error_and_by_what_it_costs(tiny_store, tmp_path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=24, slots=5))
    features = store.array("vl/features")
    features[..., 3] *= 1000  # as the few huge channels of large models
    weights = np.random.default_rng(1).normal(size=(8, 4)).astype(np.float32)
    small = features / features.std(axis=(0, 1))
    store.array("tick/action")[:, :4] = small[store.array("tick/vl_row"), 3] @ weights
    few = {"pca": 8, "then": "int8"}
    study = probed(store, horizon=1, codecs=("float32", "float8", "int8", few))
    groups = len(study.groups)
    float32, float8, int8, pca = (study.codecs[at::4] for at in range(4))
    assert groups == len(float32) and all(result.error == 0 for result in float32)
    assert all(result.difference.value == 0 for result in float32)
    assert [result.row_bytes for result in (*float32, *float8)] == groups * [5 * 8 * 4] + groups * [
        5 * (8 + 2)
    ]
    # Scales of their own keep float8 within its codes; int8 shares a scale with the huge channel.
    assert all(0 < result.error < 0.06 for result in float8)
    assert all(result.error > 0.5 for result in int8)
    assert all(result.difference.value < -0.2 for result in int8)
    # Each channel was standardised before, so that the huge one costs the others nothing.
    assert all(0 < result.error < 0.03 for result in pca)
    assert all(abs(result.difference.value) < 0.01 for result in pca)
    assert {result.codec for result in pca} == {"pca 8 in int8"}
    fewer = probed(store, horizon=1, codecs=({"pca": 2, "then": "float32"},)).codecs
    assert all(0.5 < result.error < 1 and result.row_bytes == 5 * 2 * 4 for result in fewer)
    with pytest.raises(ConfigError, match="Set pca to at most 8"):
        probed(store, codecs=({"pca": 9},))
    assert metrics(study)["codecs"][study.groups[0].name.label]["int8"]["row_bytes"] == 50
    assert "R2 minus stored" in table(study)
    assert "s a pass" not in table(study)
    timed = replace(study, seconds={0: 0.0123})
    assert "s a pass" in table(timed) and "0.0123" in table(timed)
    assert metrics(timed)["pass_s"] == {"0": 0.0123}


def test_directions_of_too_few_rows_are_refused(tiny_store, tmp_path, monkeypatch) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, slots=1))
    assert probed(store, max_ticks=8).groups
    with pytest.raises(ConfigError, match=r"pca 8: .* has 8\. Set a smaller pca"):
        probed(store, codecs=({"pca": 8},), max_ticks=8)
    monkeypatch.setattr("pipeline.evaluate.probe.study.SAMPLE_ROWS", 7)  # as in an extraction
    with pytest.raises(ConfigError, match=r"pca 8: .* has 7\. Set a smaller pca"):
        probed(store, codecs=({"pca": 8},))


def plain(
    study: ProbeStudy, store: FeatureStore, slots: tuple[int, ...], score: ProbeScore
) -> np.ndarray:
    """The inputs of these slots; the score is that of ridge regression on the rows.

    Every tick is a row of its own, although the store is read a VL row at a time; where a slot is
    not valid its mean is read.
    """
    ticks, fold = study.folds.ticks, study.folds.fold
    rows, first, of_tick = np.unique(
        store.array("tick/vl_row")[ticks], return_index=True, return_inverse=True
    )
    columns = []
    for slot in slots:
        valid = store.array("vl/slot_valid")[rows, slot] != 0
        columns.append(np.zeros((len(rows), 8)))
        raw = store.array("vl/features")[rows[valid], slot].astype(np.float64)
        columns[-1][valid] = limited(raw, fold[:, first[valid]])
    x = np.hstack(columns)[of_tick]
    y = store.array("tick/action").astype(np.float64)[ticks[:, None] + np.arange(2)]
    y = y.reshape(len(y), -1)
    varies = y.std(0) > 0
    for repeat, deal in enumerate(fold):
        r2, chosen = nested(x, y, deal, PENALTIES)
        scored = r2_by_fold(score, study.folds, repeat)
        np.testing.assert_allclose(scored[:, varies], r2[:, varies], atol=1e-8)
        np.testing.assert_array_equal(score.penalties[repeat], chosen)
    return x


def test_scores_are_those_of_a_plain_ridge_regression(store: FeatureStore) -> None:
    """A feature rests but in one recording, and another has a spike."""
    store.array("vl/features")[10:, 0, 2] = 0.5
    store.array("vl/features")[33, 1, 3] = 300
    study = probed(store, folds=3, repeats=2)
    first, second, _ = (plain(study, store, one.slots, one.alone) for one in study.slots)
    assert (first[:, 2] == 0).all() and np.abs(second[:, 3]).max() < 30
    (group,) = study.groups
    plain(study, store, (0, 1, 2), group.alone)
    assert (group.channels, group.inputs) == (24, 24)


def test_a_slot_stands_at_its_mean_where_it_is_not_valid(store: FeatureStore) -> None:
    store.array("vl/slot_valid")[12:17, 1] = 0
    store.array("vl/features")[12:17, 1] = np.nan  # what is not valid is not read
    study = probed(store, folds=3, repeats=2)
    there = ~np.isin(store.array("tick/vl_row")[study.folds.ticks], range(12, 17))
    assert [one.valid_share for one in (*study.slots[:2], *study.groups)] == [1, there.mean(), 1]
    plain(study, store, (1,), study.slots[1].alone)


def test_a_slot_that_is_valid_nowhere_says_nothing(store: FeatureStore) -> None:
    store.array("vl/slot_valid")[:, 1] = 0
    study = probed(store)
    assert (study.slots[1].inputs, study.slots[1].valid_share) == (0, 0)
    assert study.slots[1].alone.mean == study.mean_action.mean
    store.array("vl/slot_valid")[:10, 1] = 1  # in one recording only
    probed(store)
    metrics(study)


def test_only_the_plain_variant_is_read(tiny_store: Make, tmp_path: Path) -> None:
    plain = {"layer": 1, "norm": True, "pooling": "mean"}
    slots = [{**plain, "pooling": pooling} for pooling in ("mean", "last")]
    path = tiny_store(tmp_path, slots=6)
    store = renamed(path, [one | {"variant": v} for v in range(3) for one in slots], variants=3)
    before = probed(store)
    assert [one.name.pooling for one in before.slots] == ["mean", "last"]
    store.array("vl/features")[:, 2:] = np.nan
    after = probed(store)
    for one, other in zip(before.slots, after.slots, strict=True):
        np.testing.assert_array_equal(one.alone.losses, other.alone.losses)


def test_a_wide_group_is_read_along_its_main_directions(store, monkeypatch) -> None:
    monkeypatch.setattr("pipeline.evaluate.probe.inputs.WIDTH", 12)
    study = probed(store)
    (group,) = study.groups
    assert (group.channels, group.inputs) == (24, 12)
    said = table(study)
    assert all(result.name.label in said for result in (*study.slots, group))


def test_threads_change_no_bit(store: FeatureStore) -> None:
    before, after = probed(store, threads=1), probed(store, threads=3)
    for one, other in zip(
        [*before.slots, *before.groups], [*after.slots, *after.groups], strict=True
    ):
        np.testing.assert_array_equal(one.beside.losses, other.beside.losses)


def test_a_number_that_is_none_is_named(store: FeatureStore) -> None:
    store.array("vl/features")[12, 1, 4] = np.nan
    with pytest.raises(NumericsError, match=r"slot 1: .*episode_001, VL row 2 .*, channel 4"):
        probed(store, max_ticks=60)
    store.array("vl/features")[12, 1, 4] = 0
    store.array("tick/action")[40, 1] = np.inf
    with pytest.raises(
        NumericsError, match=r"actions: .* found inf at .*episode_001, .*channel 'dy'"
    ):
        probed(store)


def test_what_is_known_grows_by_what_the_store_has(tiny_store, tmp_path, store) -> None:
    names = [known.name for known in probed(store).known]
    assert names == ["past actions", "past actions + state", "past actions + state + sensor"]
    study = probed(FeatureStore.open(tiny_store(tmp_path, sensor_channels=0, state_dim=0)))
    assert [(known.name, known.inputs) for known in study.known] == [("past actions", 2 * 5)]


def test_the_cheapest_of_those_that_are_tied_is_recommended(tiny_store, tmp_path) -> None:
    """Two layers hold the same numbers, a third pooling holds noise."""
    slots = [
        {"layer": 7, "norm": True, "pooling": "mean"},
        {"layer": 2, "norm": False, "pooling": "mean"},
        {"layer": 2, "norm": False, "pooling": "last"},
    ]
    store = renamed(tiny_store(tmp_path, episodes=20), slots)
    store.array("vl/features")[:, 1] = store.array("vl/features")[:, 0]
    study = probed(store, horizon=1)
    found = recommend(study)
    assert found.reading == "beside"
    assert [one.name.layer for one in found.tied] in ([2], [7])
    said = advice(study)
    assert "vlm: {layers: [2], norms: [false], pooling: [mean]}" in said
    assert "ahead of these by a difference that is not resolved" in said


def by_recording(*values: float) -> ProbeScore:
    """One target, as many ticks of each recording."""
    losses = 9 * (1 - np.array(values))[None, :, None]
    return ProbeScore(losses, np.full(len(values), 9.0), np.ones((1, len(values))))


def study_of(known: ProbeScore, *groups: tuple[int, ProbeScore, ProbeScore]) -> ProbeStudy:
    """Groups of so many slots, alone and beside what is known."""
    folds = ProbeFolds(np.arange(45), np.arange(45) // 9, np.arange(5)[None], ())
    results = tuple(
        ProbeResult(SlotName(layer, True, "mean"), tuple(range(slots)), 8, 8, 1.0, alone, beside)
        for layer, (slots, alone, beside) in enumerate(groups)
    )
    mean_action = by_recording(-0.02, 0.01, 0.0, -0.01, 0.0)
    return ProbeStudy(1, folds, mean_action, (Known("past actions", 3, known),), (), results)


def test_nothing_is_recommended_that_is_worse_than_what_is_known() -> None:
    """Intervals so wide that all are within that of all; or one strange recording."""
    wild = by_recording(0.3, 0.1, 0.2, 0.2, -5600)
    worse = by_recording(0.4, 0.2, 0.2, 0.2, -170)
    less = by_recording(0.4, 0.2, 0.3, 0.2, -4)
    poor = by_recording(-0.1, 0.1, -0.2, 0.0, -0.1)
    study = study_of(wild, (1, poor, worse), (16, poor, less))
    assert recommend(study) is None
    assert "recommended" not in metrics(study)
    assert advice(study).startswith("no recommendation")
    known, saved = by_recording(0.1, 0.1, 0.1, 0.1, -90.0), by_recording(0.0, 0.0, 0.0, 0.0, 0.5)
    assert recommend(study_of(known, (1, by_recording(0, 0, 0, 0, 0), saved))) is None


def test_nothing_is_recommended_that_may_explain_nothing() -> None:
    """Better than a mean action that is far off, and itself not to be told from 0."""
    unclear = by_recording(0.2, -0.2, 0.1, -0.15, 0.12)
    study = study_of(unclear, (1, unclear, unclear))
    study = replace(study, mean_action=by_recording(-0.6, -0.9, -0.7, -0.9, -0.6))
    assert study.groups[0].alone.gain(study.mean_action).resolved
    assert recommend(study) is None


def test_features_that_help_alone_are_said_to() -> None:
    wild, beside = by_recording(0.3, 0.1, 0.2, 0.2, -5600), by_recording(0.4, 0.2, 0.3, 0.2, -4)
    good, better = by_recording(0.2, 0.1, 0.2, 0.3, 0.2), by_recording(0.4, 0.3, 0.4, 0.5, 0.4)
    study = study_of(wild, (1, good, beside), (16, better, beside))
    found = recommend(study)
    assert (found.reading, found.chosen.name.layer, found.tied) == ("alone", 1, ())
    assert "features alone" in advice(study) and "layers: [1]" in advice(study)


def test_a_tie_keeps_half_of_the_gain() -> None:
    known = by_recording(0.1, 0.1, 0.1, 0.1, 0.1)
    best = by_recording(0.9, 0.9, 0.9, 0.9, 0.9)
    wide = by_recording(0.8, 0.95, 0.95, 0.95, 0.4)
    wider = by_recording(0.95, 0.95, 0.95, 0.95, -1.5)
    found = recommend(study_of(known, (9, known, best), (4, known, wide), (1, known, wider)))
    assert found.best.beside is best
    assert [one.name.layer for one in found.tied] == [1]
    assert found.chosen.name.layer == 1
