"""Rates, jitter and gaps of a clock."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.look.recording.clocks import Clock, Gap, read_clocks, usual_step
from pipeline.look.recording.episode import EpisodeView


def gaps(time: np.ndarray) -> tuple[Gap, ...]:
    return Clock("sensor", "stream", time).gaps


@pytest.mark.parametrize("format", ["raw", "new", "old", "lerobot"])
def test_every_clock_of_a_recording(healthy: Path, look: Callable[..., EpisodeView], format: str):
    view = look(healthy / format)
    assert view.timeline is not None
    found = {clock.name: clock for clock in read_clocks(view)}
    views = {"view View1", "view View2", "view View5"}
    assert set(found) == views | {"ticks", "VL rows"} | view.streams.keys()
    assert found["ticks"].kind == "tick" and found["VL rows"].kind == "vl_row"
    assert found["view View1"].kind == "camera" and found["sensor"].kind == "stream"
    assert found["ticks"].rate_hz == pytest.approx(10)
    assert found["VL rows"].rate_hz == pytest.approx(10 / 3)
    assert found["ticks"].mean_rate_hz == pytest.approx(10)
    assert found["view View2"].mean_rate_hz <= found["view View2"].rate_hz * 1.01
    assert found["sensor"].rate_hz == pytest.approx(10 if format == "old" else 650, rel=0.01)
    # The simulated raw recorder loses five rows of the robot's in every episode.
    assert len(found["state"].gaps) == (format == "raw")


def test_one_lost_entry_is_no_gap_and_two_are() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(100) / 10 + rng.normal(0, 0.004, 100)
    assert gaps(np.delete(time, 50)) == ()
    (gap,) = gaps(np.delete(time, [50, 51]))
    assert (gap.start_s, gap.stop_s) == (time[49], time[52])


def test_stamps_in_bursts_are_no_gaps() -> None:
    time = np.repeat(np.arange(200) / 130, 5)
    assert usual_step(time) == pytest.approx(1 / 650, rel=0.2)
    assert np.isfinite(usual_step(np.array([0.0, 1.0])))
    assert gaps(time) == ()
    late = time.copy()
    late[500:] += 1.0
    (gap,) = gaps(late)
    assert gap.start_s == late[499]


def test_whole_packets_with_one_stamp_have_a_rate() -> None:
    time = np.repeat(np.arange(100) / 10, 65)
    assert usual_step(time) == pytest.approx(1 / 650, rel=0.02)
    assert gaps(time) == ()
    (gap,) = gaps(np.delete(time, np.s_[650:975]))
    assert gap.stop_s - gap.start_s == pytest.approx(0.6)


def test_a_clock_that_only_repeats_has_no_gap() -> None:
    assert usual_step(np.zeros(50)) == 0
    assert gaps(np.zeros(50)) == ()


def test_short_clocks_have_no_rate() -> None:
    assert np.isnan(usual_step(np.array([3.0])))
    assert gaps(np.array([3.0, 9.0])) == ()
