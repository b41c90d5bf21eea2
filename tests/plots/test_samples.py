"""Pictures of training samples and of their batch mark what is not real."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from pipeline.datasets import UnifiedBatch, UnifiedVLADataset, unified_collate_fn
from pipeline.plots import recording
from pipeline.plots.recording.masks import MASKED, MISSING, PADDED, REAL

Drawn = tuple[UnifiedVLADataset, UnifiedBatch]


@pytest.fixture(scope="module")
def drawn(raw: Path) -> Drawn:
    """The first tick, one within, and the last."""
    dataset = UnifiedVLADataset(raw, horizon=4, sensor_window_size=65, state_window_size=20)
    return dataset, unified_collate_fn([dataset[at] for at in (0, 20, len(dataset) - 1)])


def kinds(figure: Figure, title: str) -> np.ndarray:
    axis = next(axis for axis in figure.axes if axis.get_title(loc="left").startswith(title))
    return np.asarray(axis.images[0].get_array())


def test_samples_have_a_column_each_and_say_what_they_reuse(drawn: Drawn) -> None:
    dataset, batch = drawn
    figure = recording.samples(dataset, batch)
    # Three views, force, A-scan, state in deg and mm, action in mm, deg and gripper.
    assert len(figure.axes) == 3 * 10
    title = figure.axes[1].get_title()
    assert f"tick 20 of {len(dataset)}" in title
    assert "reuses VL row 6, 2 ticks old" in title
    assert f"{1000 * float(batch.feature_age[1]):.0f} ms old" in title


def test_padding_and_masked_steps_are_hatched(drawn: Drawn) -> None:
    _, batch = drawn
    figure = recording.samples(*drawn)
    force, gripper = figure.axes[9:12], figure.axes[27:30]
    (padding,) = [one for one in force[0].patches if one.get_hatch()]
    assert padding.get_width() == pytest.approx(65 - int(batch.sensor_valid[0]))
    assert not [one for one in force[1].patches if one.get_hatch()]
    masked = [one.get_x() for one in gripper[2].patches if one.get_hatch()]
    assert masked == [1, 2, 3]
    assert not [one for one in gripper[1].patches if one.get_hatch()]


def test_streams_that_all_samples_lack_are_said(
    drawn: Drawn, words_of: Callable[[Figure], str]
) -> None:
    dataset, batch = drawn
    missing = replace(batch, sensor_valid=torch.zeros(3, dtype=torch.int64))
    assert words_of(recording.samples(dataset, missing)).count("sensor missing") == 6
    assert (kinds(recording.batch(missing), "sensor window") == MISSING).all()
    views = [{}, *(batch.images or [])[1:]]
    assert (
        words_of(recording.samples(dataset, replace(batch, images=views))).count("view missing")
        == 3
    )
    assert (kinds(recording.batch(replace(batch, images=views)), "frames")[0] == MISSING).all()
    without = replace(
        batch, state=torch.zeros(3, 20, 0), state_valid=torch.zeros(3, dtype=torch.int64)
    )
    assert "not in this data set" in words_of(recording.batch(without))


def test_the_map_of_a_batch_tells_real_from_padded_and_masked(drawn: Drawn) -> None:
    _, batch = drawn
    figure = recording.batch(batch)
    sensor = kinds(figure, "sensor window")
    assert sensor.shape == (3, 65)
    assert (sensor == REAL).sum(axis=1).tolist() == batch.sensor_valid.tolist()
    assert sensor[0, 0] == PADDED
    assert sensor[0, -1] == REAL
    assert kinds(figure, "action chunk")[2].tolist() == [REAL, MASKED, MASKED, MASKED]
