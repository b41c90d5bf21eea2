"""Statistics by channel are those of the recording, and like channels are one row of the table."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Params
from pipeline.base.text import Table
from pipeline.data import Channels, Stream
from pipeline.look.recording.episode import EpisodeView
from pipeline.look.recording.streams import describe_channels, statistics_blocks

Look = Callable[..., EpisodeView]
PARAMS = Params.model_validate(
    {"data": {"sources": [{"name": "s", "path": "."}]}, "vlm": {"checkpoint": "none"}}
)


def table_of(view: EpisodeView) -> Table:
    (table,) = statistics_blocks(view, lambda *_: pytest.fail("draws nothing"), PARAMS)
    assert isinstance(table, Table)
    return table


@pytest.mark.parametrize("channels", [1, 2, 17])
def test_statistics_leave_the_values_as_they_are(channels: int) -> None:
    values = np.random.default_rng(0).normal(size=(50, channels)).astype(np.float32)
    before = values.copy()
    assert describe_channels(values, range(channels)).shape == (channels, 7)
    assert np.array_equal(values, before)


def test_statistics_of_every_channel(healthy: Path, look: Look) -> None:
    view = look(healthy / "raw")
    rows = {row[:2]: row[2:] for row in table_of(view).rows}
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


def test_channels_that_differ_by_a_number_are_one_row(healthy: Path, look: Look) -> None:
    names = ("force", *(f"aline_{depth:04d}" for depth in range(100)))
    values = np.array([[5.0, *range(100)], [5.0, *range(1, 101)]], np.float32)
    sensor = Stream(Channels(names, ("N",) * 101), np.arange(2.0), values)
    view = replace(look(healthy / "raw"), sensor=sensor)
    force, joint, *_ = table_of(view).rows
    assert force[1] == "force"
    assert joint[:4] == ("sensor", "aline_0000 … aline_0099 (100 channels)", "N", 2)
    assert (joint[4], joint[8], joint[9]) == (0, 100, 50)
