"""Statistics by channel are those of the recording, and like channels are one row of the table."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.look.recording.channels import (
    ChannelStatistics,
    channel_statistics,
    statistics_of,
    statistics_table,
)
from pipeline.look.recording.episode import EpisodeView

Look = Callable[..., EpisodeView]


@pytest.mark.parametrize("channels", [1, 2, 17])
def test_statistics_leave_the_values_as_they_are(channels: int) -> None:
    values = np.random.default_rng(0).normal(size=(50, channels)).astype(np.float32)
    before = values.copy()
    names = [f"c{index}" for index in range(channels)]
    assert len(list(statistics_of("state", names, names, values))) == channels
    assert np.array_equal(values, before)


def test_statistics_of_every_channel(healthy: Path, look: Look) -> None:
    view = look(healthy / "raw")
    found = {(one.stream, one.name): one for one in channel_statistics(view)}
    assert view.sensor is not None and view.state is not None and view.timeline is not None
    # Poses are columns of the state.
    assert len(found) == 1026 + 12 + 7
    force = view.sensor.values[:, 0].astype(np.float64)
    one = found["sensor", "force"]
    assert (one.unit, one.readings) == ("N", len(force))
    assert (one.minimum, one.maximum) == (force.min(), force.max())
    assert one.median == np.median(force) and one.mean == pytest.approx(force.mean())
    assert one.std == pytest.approx(force.std())
    assert (one.low, one.high) == pytest.approx(tuple(np.percentile(force, [1, 99])))
    scan = found["sensor", "aline_0700"]
    assert scan.mean == pytest.approx(view.sensor.values[:, 701].mean(dtype=np.float64))
    assert found["action", "dx"].maximum == view.timeline.action[:, 0].max()


def test_channels_that_differ_by_a_number_are_one_row() -> None:
    def channel(name: str, value: float) -> ChannelStatistics:
        seven = (value, value, value, value, value + 1, value, 0.0)
        return ChannelStatistics("sensor", name, "N", 10, *seven)

    many = [channel(f"aline_{depth:04d}", depth) for depth in range(100)]
    table = statistics_table([channel("force", 5.0), *many])
    force, joint = table.rows
    assert force[1] == "force"
    assert joint[1] == "aline_0000 … aline_0099 (100 channels)"
    assert joint[4:] == (0, 49.5, 49.5, 49.5, 100, 49.5, 0.0)
