"""Rates, jitter and gaps of a clock; clocks that were set, and streams and frames that lack."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.base.errors import Issue
from pipeline.look.recording.clocks import Clock, Gap, find_clock_issues, usual_step
from pipeline.look.recording.episode import LoadedRecording


def gaps(time: np.ndarray) -> tuple[Gap, ...]:
    return Clock("sensor", "stream", time).gaps


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


FAST = np.arange(39000) / 650
SLOW = np.arange(6000) / 100
CAMERA = np.arange(600) / 10
Find = Callable[[Mapping[str, np.ndarray]], tuple[Issue, ...]]


def set_by(time: np.ndarray, seconds: float, at: float = 30) -> np.ndarray:
    return time + seconds * (time >= at)


@pytest.fixture
def find(healthy: Path, look: Callable[..., LoadedRecording]) -> Find:
    """`find({"sensor": time, "view View1": time})`: clock issues of streams with these times."""
    view = look(healthy / "raw")

    def issues(clocks: Mapping[str, np.ndarray]) -> tuple[Issue, ...]:
        streams = {
            name: replace(stream, time=clocks[name])
            for name, stream in view.streams.items()
            if name in clocks
        }
        cameras = {
            name.removeprefix("view "): SimpleNamespace(time=time)
            for name, time in clocks.items()
            if name.startswith("view ")
        }
        absent = {"sensor": None, "state": None, "poses": None, "action": None}
        one = replace(view, timeline=None, cameras=cameras, zero=0.0, **absent | streams)
        return tuple(find_clock_issues(one))

    return issues


def test_a_clock_that_was_set_is_a_gap_of_that_clock_alone(find: Find) -> None:
    (issue,) = find({"sensor": set_by(FAST, 5.0), "state": SLOW})
    assert (issue.kind, issue.stream) == ("gap", "sensor")
    assert issue.start_s == pytest.approx(30, abs=0.01)
    late = {f"view View{place}": set_by(CAMERA + 0.03 * place, 5) for place in (1, 2, 5)}
    found = find({"sensor": FAST, "state": SLOW, **late})
    assert [issue.kind for issue in found] == ["gap"] * 3


def test_frames_that_are_lost_have_a_place(find: Find) -> None:
    burst = np.arange(200, 240, 2)
    (issue,) = find({"view View1": np.delete(CAMERA, [5, *burst, *range(300, 600, 30)])})
    assert issue.kind == "dropped frames"
    assert issue.start_s is not None and issue.stop_s is not None
    assert (issue.start_s, issue.stop_s) == pytest.approx((0.4, 57.1))


def test_times_that_repeat_are_told(find: Find) -> None:
    time = np.arange(0, 30, 0.01)
    (issue,) = find({"sensor": np.repeat(time[::2], 2), "state": time})
    assert (issue.kind, issue.stream) == ("repeated times", "sensor")
    assert issue.message == "1500 of 3000 entries have the time of the entry before"
