"""Clipped readings are found, also where they are most; what rests at its end is not."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import Issue

Change = Callable[[np.ndarray], np.ndarray]
Found = Callable[..., tuple[Issue, ...]]


@pytest.fixture
def with_sensor(
    copied: Callable[[str], Path], issues_of: Found, change_npz: Callable[..., None]
) -> Found:
    """`with_sensor(forces=…, alines=…)`: what is found after members were changed."""

    def find(**changes: Change) -> tuple[Issue, ...]:
        folder: Path = copied("raw")
        (path,) = folder.glob("sensor_data_*.npz")
        change_npz(path, **changes)
        return issues_of(folder)

    return find


def loaded(force: np.ndarray) -> np.ndarray:
    """Noise about zero, then a load of 1 N for three quarters of the readings."""
    noise = np.random.default_rng(0).normal(0, 0.005, len(force)).astype(np.float32)
    return noise + (np.arange(len(force)) >= len(force) // 4)


def test_a_force(with_sensor: Found) -> None:
    (issue,) = with_sensor(forces=lambda f: np.minimum(f, 0.4))
    assert (issue.kind, issue.stream) == ("saturated", "sensor")
    assert "force (1 of 1026 channels)" in issue.message and "0.4" in issue.message
    assert issue.start_s is not None and issue.stop_s is not None and issue.start_s < issue.stop_s


@pytest.mark.parametrize("sign", [1, -1])
def test_a_force_clipped_in_most_readings(with_sensor: Found, sign: int) -> None:
    (issue,) = with_sensor(forces=lambda f: sign * np.minimum(loaded(f), 0.3))
    end = "upper" if sign > 0 else "lower"
    assert f"the {end} end of their range, {sign * 0.3:g}, in 75.0 % of" in issue.message


def test_a_scan(with_sensor: Found) -> None:
    (issue,) = with_sensor(alines=lambda a: np.minimum(a, 130))
    assert issue.kind == "saturated" and "aline_" in issue.message
    assert "upper end of their range, 130" in issue.message


def test_the_brightest_depths_of_a_scan_are_clipped_too(with_sensor: Found) -> None:
    def amplify(scan: np.ndarray) -> np.ndarray:
        rail = scan.max() / 5
        clipped = np.minimum(scan, rail)
        clipped[:, 40] = rail
        clipped[1000, 40] = 0  # at the rail but once
        assert (clipped[:, 30:230] == rail).mean() > 0.25
        return clipped

    (issue,) = with_sensor(alines=amplify)
    assert (
        issue.message.startswith("aline_0000–aline_")
        and "upper end of their range" in issue.message
    )
    channels = re.search(r"\((\d+) of 1026 channels\)", issue.message)
    assert channels is not None and int(channels[1]) > 1000


@pytest.mark.parametrize(
    "rest",
    [
        pytest.param(lambda f: np.maximum(loaded(f), 0.02), id="from the start"),
        pytest.param(lambda f: np.maximum(loaded(f), 0.02) - 5.02, id="biased"),
        pytest.param(lambda f: np.maximum(1 - loaded(f), 0.02), id="touching at the start"),
        pytest.param(lambda f: np.where(loaded(f) > 0.5, 0.5, 0.1), id="a switch"),
    ],
)
def test_a_force_that_rests_at_its_end_is_not_clipped(with_sensor: Found, rest: Change) -> None:
    assert [issue for issue in with_sensor(forces=rest) if issue.kind == "saturated"] == []
