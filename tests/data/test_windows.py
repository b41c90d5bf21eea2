"""Windows cut from a stream with a jittering clock give that stream back."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.base.errors import RecordingError
from pipeline.data.windowed import rebuild


def cut(values: np.ndarray, time: np.ndarray, width: int, stride: int):
    stops = np.arange(width, len(values) + 1, stride)
    return time[stops - 1], np.stack([values[stop - width : stop] for stop in stops]), stops[-1]


@settings(deadline=None, max_examples=60)
@given(
    width=st.integers(2, 40),
    overlap=st.floats(0, 0.95),
    windows=st.integers(2, 30),
    jitter=st.floats(0, 0.05),
    hz_error=st.floats(0.98, 1.02),
    held=st.integers(1, 3),
    seed=st.integers(0, 999),
)
@example(width=3, overlap=0.0, windows=2, jitter=0.0, hz_error=1.0, held=2, seed=0)
def test_any_cut_is_undone(width, overlap, windows, jitter, hz_error, held, seed):
    stride = max(1, round(width * (1 - overlap)))
    rng = np.random.default_rng(seed)
    count = width + stride * (windows - 1)
    # A sensor slower than its stream repeats readings.
    values = np.repeat(rng.normal(size=(count, 3)), held, axis=0)[:count]
    time = 100 + np.arange(count) / 650
    ends, data, stop = cut(values, time, width, stride)
    ends = np.sort(ends + rng.uniform(-jitter, jitter, len(ends)) * stride / 650)
    rebuilt_time, rebuilt = rebuild(ends, data, 650 * hz_error, "x")
    if held == 1:
        np.testing.assert_array_equal(rebuilt, values[:stop])
        assert np.abs(rebuilt_time - time[:stop]).max() < (0.11 * stride + 0.03 * width) / 650
    assert len(rebuilt) == len(rebuilt_time)
    assert (np.diff(rebuilt_time) >= 0).all() and rebuilt_time[-1] == ends[-1]


def stream(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(0).normal(size=(count, 3)), 50 + np.arange(count) / 100


@pytest.mark.parametrize(("width", "stride"), [(20, 20), (20, 5)])
def test_a_gap_stays_a_gap(width, stride):
    values, time = stream()
    ends, data, _ = cut(values, time, width, stride)
    lost = slice(5, 5 + 2 * width // stride)
    ends, data = np.delete(ends, lost), np.delete(data, lost, axis=0)
    rebuilt_time, rebuilt = rebuild(ends, data, 100.0, "x")
    begin = 5 * stride + width - stride
    first_after = round((ends[5] - 50) * 100) + 1 - width
    np.testing.assert_array_equal(rebuilt, np.delete(values, slice(begin, first_after), axis=0))
    np.testing.assert_allclose(rebuilt_time, np.delete(time, slice(begin, first_after)), atol=1e-9)
    assert np.diff(rebuilt_time).max() > 0.15


def test_a_lost_window_whose_readings_stand_in_the_next_loses_nothing():
    values, time = stream()
    ends, data, stop = cut(values, time, 20, 5)
    rebuilt_time, rebuilt = rebuild(np.delete(ends, 7), np.delete(data, 7, axis=0), 100.0, "x")
    np.testing.assert_array_equal(rebuilt, values[:stop])
    np.testing.assert_allclose(rebuilt_time, time[:stop], atol=1e-9)


@pytest.mark.parametrize(("width", "stride"), [(20, 20), (20, 5)])
def test_without_a_rate_the_window_ends_tell(width, stride):
    values, time = stream()
    ends, data, stop = cut(values, time, width, stride)
    rebuilt_time, rebuilt = rebuild(ends, data, None, "x")
    np.testing.assert_array_equal(rebuilt, values[:stop])
    np.testing.assert_allclose(rebuilt_time, time[:stop], atol=1e-9)


def test_a_sensor_that_stands_still_is_cut_by_the_clock():
    time = np.arange(400) / 100
    ends, data, stop = cut(np.zeros((400, 3)), time, 20, 5)
    rebuilt_time, rebuilt = rebuild(ends, data, 100.0, "x")
    assert rebuilt.shape == (stop, 3)
    np.testing.assert_allclose(rebuilt_time, time[:stop], atol=1e-9)


def test_one_window_is_dated_back_from_its_end():
    time, values = rebuild(np.array([10.0]), np.ones((1, 5, 2)), 100.0, "x")
    np.testing.assert_allclose(time, [9.96, 9.97, 9.98, 9.99, 10.0])
    assert values.shape == (5, 2)


def test_one_window_without_a_rate_cannot_be_dated():
    with pytest.raises(RecordingError, match="sensor_hz"):
        rebuild(np.array([10.0]), np.ones((1, 5, 2)), None, "x")


def test_overlap_by_the_clock_with_other_readings_is_a_contradiction():
    values, time = stream()
    ends, data, _ = cut(values, time, 20, 5)
    data[9] = np.random.default_rng(1).normal(size=data[9].shape)
    with pytest.raises(RecordingError, match=r"file\.npz: windows 8 and 9 overlap"):
        rebuild(ends, data, 100.0, "file.npz")


def test_nan_is_named_by_window_and_reading():
    values, time = stream()
    ends, data, _ = cut(values, time, 20, 5)
    data = data.copy()
    data[9, 4, 1] = np.nan
    with pytest.raises(RecordingError, match="nan in window 9, reading 4, channel 1"):
        rebuild(ends, data, 100.0, "x")


@pytest.mark.parametrize("width", [2, 5])
def test_one_shared_reading_contradicts_a_rate_too(width):
    values, time = stream()
    ends, data, stop = cut(values, time, width, width - 1)
    with pytest.raises(RecordingError, match="must agree"):
        rebuild(ends, data, 50.0, "x")
    rebuilt_time, _ = rebuild(ends, data, 100.0, "x")
    np.testing.assert_allclose(rebuilt_time, time[:stop], atol=1e-9)
