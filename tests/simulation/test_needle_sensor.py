"""The sensor's rows, apart from any episode."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from pipeline.simulation.needle_sensor import (
    A_SCAN_BINS,
    BIN_MM,
    READINGS_PER_SCAN,
    SCANS_LATE,
    NeedleContact,
    NeedleSensor,
)

NOW = np.zeros(1)


def outside(distance_mm: float, layer_depth_mm: float, rows: int) -> NeedleContact:
    """A needle that hangs still above the tissue."""
    return NeedleContact(
        distance_mm=np.full(rows, distance_mm),
        layer_mm=np.full(rows, distance_mm + layer_depth_mm),
        inside=np.zeros(rows, np.bool_),
        force_n=np.zeros(rows),
    )


@given(st.floats(0, 5.0), st.floats(1.5, 4.0), st.floats(0.92, 1.08), st.integers(0, 99))
@example(4.611, 2.001, 1.0, 64)  # speckle moves the peak by 16 bins
@example(1.0, 2.0, 1.08, 22)  # the layer saturates as the surface does
def test_nothing_is_brighter_than_the_surface(distance, layer_depth, gain, seed):
    sensor = NeedleSensor(gain, seed)
    scan = sensor.a_scans(outside(distance, layer_depth, 1), NOW, np.random.default_rng(seed))[0]
    # Speckle moves the peak by at most 16 bins in 18,000 scans; its light is 14 bins wide.
    brightest = np.flatnonzero(scan == scan.max())
    assert np.abs(brightest - distance / BIN_MM).min() <= 28
    assert scan.min() >= 0 and scan.max() <= 255
    np.testing.assert_array_equal(scan, np.rint(scan))


def test_each_scan_is_read_five_times_and_each_force_once() -> None:
    rows = NeedleSensor(1.0, 0).read(outside(1.0, 2.0, 650), 0.0, np.random.default_rng(0))
    assert rows.shape == (650, 1 + A_SCAN_BINS) and rows.dtype == np.float32
    held = rows[:, 1:].reshape(-1, READINGS_PER_SCAN, A_SCAN_BINS)
    assert (held == held[:, :1]).all()
    repeated = (held[SCANS_LATE + 1 :, 0] == held[SCANS_LATE:-1, 0]).all(axis=1)
    assert 0 < repeated.sum() < 12  # a lost scan is the last one again
    assert len(np.unique(rows[:, 0])) > 20


def test_scans_come_late_and_go_on_where_the_last_tick_ended() -> None:
    """A step of the distance shows two scans later, also across the end of a tick."""
    before, after = outside(3.0, 2.0, 65), outside(1.0, 2.0, 65)
    for seed in range(20):
        sensor, rng = NeedleSensor(1.0, 0), np.random.default_rng(seed)
        rows = np.concatenate([sensor.read(before, 0.0, rng), sensor.read(after, 0.1, rng)])
        scans = rows[::READINGS_PER_SCAN, 1:]
        near = np.abs(scans.argmax(axis=1) - 1.0 / BIN_MM) < 20
        shown = int(near.argmax())
        assert near[shown:].all() and shown >= 13 + SCANS_LATE
        if seed == 0:
            assert shown == 13 + SCANS_LATE
