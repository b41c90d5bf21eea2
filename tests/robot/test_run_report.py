"""Timings of parts in buffers that stay."""

import numpy as np
import pytest

from pipeline.robot.run_report import Timings


@pytest.mark.parametrize("rows", [0, 4, 11])
def test_the_newest_rows_stay_oldest_first(rows: int) -> None:
    timings = Timings("ab", 4)
    for row in range(rows):
        timings.note((row, -row))
    kept = np.arange(max(0, rows - 4), rows)
    np.testing.assert_array_equal(timings.rows(), np.stack([kept, -kept], axis=1))
    assert timings.count == rows


def test_percentiles_are_of_what_is_kept() -> None:
    timings = Timings(("act", "never", "rare"), 1000)
    timings.note(np.array([5000.0, np.nan, np.nan]))
    for value in range(1, 1001):
        timings.note(np.array([value, np.nan, 7.0 if value == 500 else np.nan]))
    told = timings.document()
    assert set(told) == {"act", "rare"}
    assert told["act"]["max"] == 1000 and told["act"]["count"] == 1000
    assert told["act"]["p50"] == pytest.approx(500.5)
    assert told["act"]["p99"] == pytest.approx(990.01)
    assert told["rare"] == {"count": 1, "p50": 7, "p99": 7, "p99.9": 7, "max": 7}
    lines = timings.table().text()
    assert lines[0].split()[0] == "part" and len(lines) == 3
