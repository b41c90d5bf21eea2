"""Several samples of a policy, and the phase of each tick."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.evaluate.evaluation import BEST, MEAN, SampledChunks, phases_of
from pipeline.store import FeatureStore

CHUNKS = np.array([[[[0.0, 9.0], [0.0, 9.0]]], [[[4.0, 9.0], [2.0, 9.0]]]], np.float32)
"""Two samples of one tick, two steps, two dimensions of which the second never varies."""
RECORDED = np.array([[[1.0, 0.0], [1.0, 0.0]]], np.float32)
SCALE = np.array([2.0, 0.0])


def taken(valid: list[bool], chunks: np.ndarray = CHUNKS) -> SampledChunks:
    sampled = SampledChunks(SCALE)
    sampled(chunks, RECORDED, np.array([valid]))
    return sampled


def test_the_mean_and_the_best_of_two() -> None:
    chunks = taken([True, True]).chunks()
    assert chunks[MEAN][0, :, 0].tolist() == [2.0, 1.0]
    assert chunks[BEST][0, :, 0].tolist() == [0.0, 0.0]


def test_what_lies_beyond_the_end_picks_no_best() -> None:
    reversed_end = CHUNKS.copy()
    reversed_end[0, 0, 1, 0] = 1e9
    assert taken([True, False], reversed_end).chunks()[BEST][0, 0, 0] == 0.0


def test_the_energy_score_by_hand() -> None:
    """Distances in std over sqrt(2): (0, 0), (2, 1) to (0.5, 0.5), and to each other."""
    distance = (np.hypot(0.5, 0.5) + np.hypot(1.5, 0.5)) / 2
    expected = (distance - np.hypot(2, 1) / 2) / np.sqrt(2)
    assert taken([True, True]).energy() == pytest.approx([expected])
    first = (0.5 + 1.5) / 2 - 2 / 2
    assert taken([True, False]).energy() == pytest.approx([first])


def test_the_energy_score_is_lowest_for_the_distribution_that_was_recorded_from() -> None:
    rng = np.random.default_rng(0)

    def score(spread: float) -> float:
        sampled = SampledChunks(np.ones(2))
        recorded = rng.normal(size=(1000, 1, 2))
        chunks = spread * rng.normal(size=(6, 1000, 1, 2))
        sampled(chunks, recorded, np.ones((1000, 1), bool))
        return float(sampled.energy().mean())

    assert score(1.0) < min(score(0.3), score(2.0))


def test_of_one_sample_there_is_nothing_to_say() -> None:
    sampled = taken([True, True], CHUNKS[:1])
    assert sampled.chunks() == {} and len(sampled.energy()) == 0


TICKS = np.arange(30, 60)
"""The second episode: 8 readings a tick of 100 ms."""


@pytest.fixture
def pressed(tiny_store: Callable[..., Path], tmp_path: Path) -> FeatureStore:
    """A force of 1 N from tick 10 to 25 of the second episode; from tick 20 the robot rests."""
    store = FeatureStore.open(tiny_store(tmp_path))
    store.streams["sensor"]["names"][2] = "force"
    store.streams["sensor"]["units"][2] = "N"
    values = store.array("sensor/values")
    values[:, 2] = 0.001 * np.random.default_rng(0).normal(size=len(values))
    time, first = store.array("sensor/time"), store.array("episode/sensor_start")[1]
    at = store.array("tick/time")[TICKS]
    here = slice(first, store.array("episode/sensor_start")[2])
    values[here, 2] += (time[here] >= at[10]) & (time[here] < at[25])
    action = store.array("tick/action")
    action[TICKS] = 1.0
    action[TICKS[20:25], :3] = 0.1
    return store


def test_contact_is_by_the_force_and_hold_by_the_motion_in_it(pressed: FeatureStore) -> None:
    expected = ["approach"] * 10 + ["contact"] * 10 + ["hold"] * 5 + ["approach"] * 5
    found = phases_of(pressed, TICKS)
    # The first reading after the contact may lie at its last tick.
    assert (found == expected).sum() >= 29
    assert np.array_equal(phases_of(pressed, TICKS[::3]), found[::3])
    assert set(phases_of(pressed, np.arange(30))) == {"approach"}, "nothing touches"


def test_absolute_actions_rest_where_they_do_not_change(pressed: FeatureStore) -> None:
    pressed.streams["action"]["kind"] = "absolute"
    action = pressed.array("tick/action")
    action[TICKS, 0] = np.minimum(np.arange(30), 20)
    found = phases_of(pressed, TICKS)
    assert found[12] == "contact" and found[23] == "hold"


def test_without_a_force_there_are_no_phases(store, tiny_store, tmp_path):
    without = FeatureStore.open(tiny_store(tmp_path, sensor_channels=0))
    assert set(phases_of(store, TICKS)) == set(phases_of(without, TICKS)) == {""}
