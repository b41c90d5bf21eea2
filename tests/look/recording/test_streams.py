"""Statistics by channel are those of the recording; contact by the force alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.text import Table
from pipeline.data import Channels, Stream
from pipeline.data.contact import force_columns
from pipeline.look.recording.episode import LoadedRecording
from pipeline.look.recording.streams import contacts, describe_channels, statistics_blocks
from pipeline.simulation.insertion import TICK_HZ
from pipeline.simulation.recorder import Demonstration, simulate_episode
from tests.look.recording.conftest import PARAMS

Look = Callable[..., LoadedRecording]


def test_statistics_of_every_channel(healthy: Path, look: Look) -> None:
    view = look(healthy / "raw")
    (table,) = statistics_blocks(view, lambda *_: pytest.fail("draws nothing"), PARAMS)
    assert isinstance(table, Table)
    rows = {row[:2]: row[2:] for row in table.rows}
    assert view.sensor is not None and view.state is not None and view.timeline is not None
    # Poses are columns of the state, the A-scan is one row.
    assert len(rows) == 2 + 12 + 7
    force = view.sensor.values[:, 0].astype(np.float64)
    points = np.percentile(force, [0, 1, 50, 99, 100])
    expected = ("N", len(force), *points, force.mean(), force.std())
    assert rows["sensor", "force"] == pytest.approx(expected)
    scan = describe_channels(view.sensor.values, [701])
    assert scan[0, 5] == pytest.approx(view.sensor.values[:, 701].mean(dtype=np.float64))
    assert rows["action", "dx"][6] == view.timeline.action[:, 0].max()


SEEDS = (20, 23)


def depth_mm(episode: Demonstration, time_s: np.ndarray) -> np.ndarray:
    """How far the tip is below the undisturbed surface: contact where above 0."""
    knots = episode.insertion.knots
    depth = [knot.surface_mm - knot.pose[2] for knot in knots]
    return np.interp(time_s, np.arange(len(knots)) / TICK_HZ, depth)


def view_of(look_at: LoadedRecording, time: np.ndarray, values: np.ndarray, names=("force",)):
    channels = Channels(tuple(names), ("N",) * len(names))
    sensor = Stream(channels, time, np.asarray(values, np.float32).reshape(len(time), -1))
    return replace(look_at, sensor=sensor)


@pytest.fixture(scope="module")
def base(healthy: Path, look) -> LoadedRecording:
    return look(healthy / "lerobot")


@pytest.mark.parametrize("seed", SEEDS)
def test_contact_is_where_the_simulated_needle_touches(base: LoadedRecording, seed: int) -> None:
    episode = simulate_episode(seed, 0.0)
    time = episode.sensor_time
    view = view_of(base, time, episode.sensor[:, 0])
    found = np.zeros(len(time), np.bool_)
    for start, stop in contacts(view):
        found |= (time >= start) & (time <= stop)
    depth = depth_mm(episode, time)
    # A touch of under 0.15 mm makes no force that stands out of noise and drift.
    assert found[depth > 0.15].all()
    assert not found[depth <= 0].any() or found[depth <= 0].mean() < 0.02
    assert (found == (depth > 0)).mean() > 0.95
    before = time < time[np.argmax(depth > 0)] - 0.1
    assert contacts(view_of(base, time[before], episode.sensor[before, 0])) == []


def test_contact_may_pull_and_may_be_sampled_slowly(base: LoadedRecording) -> None:
    time = np.arange(60) / 10
    force = 2.0 + np.random.default_rng(0).normal(0, 0.005, 60)
    force[30:45] -= 0.5
    assert contacts(view_of(base, time, force)) == [(time[30], time[45])]


def test_contact_begins_where_the_force_rises_and_not_where_it_creeps(
    base: LoadedRecording,
) -> None:
    time = np.arange(3000) / 500
    force = 2.0 + np.random.default_rng(0).normal(0, 0.002, 3000)
    force += np.clip(time - 1, 0, 3) * 0.04 / 3  # N of drift, under the threshold
    force[2000:2750] += 0.5
    ((start, stop),) = contacts(view_of(base, time, force))
    assert start == pytest.approx(time[2000], abs=0.02)
    assert stop > time[2740]


def test_wrenches_count_by_their_length(base: LoadedRecording) -> None:
    rng = np.random.default_rng(0)
    time = np.arange(3000) / 500
    wrench = rng.normal([0.3, -9.8, 1.0], 0.01, (3000, 3))
    wrench[2000:2500] += [0.2, 0.2, 0.2]
    view = view_of(base, time, wrench, ("fx", "fy", "fz"))
    ((start, stop),) = contacts(view)
    assert (start, stop) == pytest.approx((time[2000], time[2500]), abs=0.03)


def test_no_force_no_contact(base: LoadedRecording) -> None:
    assert contacts(replace(base, sensor=None)) == []
    view = view_of(base, np.arange(100) / 10, np.linspace(0, 9, 100), ("depth",))
    assert view.sensor is not None and force_columns(view.sensor.channels.names) == []
    assert contacts(view) == []


def test_a_silent_or_short_sensor_or_a_clock_that_repeats_touches_nothing(base) -> None:
    time = np.arange(100) / 10
    for times in (time, time[:2], np.full(100, 5.0)):
        assert contacts(view_of(base, times, np.zeros(len(times)))) == []
