"""The sensor's rows, apart from any episode."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulation.needle_sensor import (
    A_SCAN_BINS,
    BIN_MM,
    READINGS_PER_SCAN,
    NeedleContact,
    a_scans,
    sensor_readings,
)


def outside(distance_mm: float, layer_depth_mm: float, rows: int) -> NeedleContact:
    """A needle that hangs still above the tissue."""
    return NeedleContact(
        distance_mm=np.full(rows, distance_mm),
        layer_mm=np.full(rows, distance_mm + layer_depth_mm),
        inside=np.zeros(rows, np.bool_),
        force_n=np.zeros(rows),
    )


@given(st.floats(0, 5.0), st.floats(1.5, 4.0), st.floats(0.9, 1.1), st.integers(0, 99))
def test_the_surface_is_the_strongest_peak(
    distance: float, layer_depth: float, gain: float, seed: int
) -> None:
    scan = a_scans(outside(distance, layer_depth, 1), gain, np.random.default_rng(seed))[0]
    # The light scattered behind the surface pulls the peak a few bins inwards.
    assert abs(scan.argmax() - distance / BIN_MM) <= 5
    assert scan.min() >= 0 and scan.max() <= 255
    np.testing.assert_array_equal(scan, np.rint(scan))


@given(st.floats(5.4, 100.0))
def test_tissue_out_of_range_leaves_the_background(distance: float) -> None:
    scans = a_scans(outside(distance, 2.0, 3), 1.0, np.random.default_rng(0))
    assert np.ptp(scans) <= 6


def test_each_scan_is_read_five_times_and_each_force_once() -> None:
    rows = sensor_readings(outside(1.0, 2.0, 65), 0.0, 1.0, np.random.default_rng(0))
    assert rows.shape == (65, 1 + A_SCAN_BINS) and rows.dtype == np.float32
    held = rows[:, 1:].reshape(-1, READINGS_PER_SCAN, A_SCAN_BINS)
    assert (held == held[:, :1]).all()
    assert (held[1:, 0] != held[:-1, 0]).any(axis=1).all()
    assert len(np.unique(rows[:, 0])) > 20
