"""Phases by force and motion: approach, contact, hold."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.evaluate.evaluation import phases_of
from pipeline.store import FeatureStore

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


def test_without_a_force_there_are_no_phases(
    store: FeatureStore, tiny_store: Callable[..., Path], tmp_path: Path
) -> None:
    without = FeatureStore.open(tiny_store(tmp_path, sensor_channels=0))
    assert set(phases_of(store, TICKS)) == set(phases_of(without, TICKS)) == {""}
