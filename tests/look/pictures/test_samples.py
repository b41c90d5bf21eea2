"""Pictures of training samples and of their batch mark what is not real."""

import io
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.colors import same_color
from matplotlib.figure import Figure
from matplotlib.text import Text

from pipeline.datasets import UnifiedBatch, UnifiedVLADataset, unified_collate_fn
from pipeline.look.recording import pictures as recording
from pipeline.look.recording.draw_masks import COLOURS, MASKED, MISSING, PADDED, REAL
from pipeline.look.recording.facts import EpisodeView

Drawn = tuple[UnifiedVLADataset, UnifiedBatch]
"""A data set, and three of its samples."""


@pytest.fixture(scope="module")
def drawn(raw: Path) -> Drawn:
    """The first tick, one within, and the last."""
    dataset = UnifiedVLADataset(raw, horizon=4, sensor_window_size=65, state_window_size=20)
    return dataset, unified_collate_fn([dataset[at] for at in (0, 20, len(dataset) - 1)])


@pytest.fixture(scope="module")
def side_by_side(drawn: Drawn) -> Figure:
    """Its samples, not to be drawn on."""
    return recording.samples(*drawn, 0.0)


@pytest.fixture(scope="module")
def batch_map(drawn: Drawn) -> Figure:
    """Its batch, not to be drawn on."""
    return recording.batch(drawn[1])


def kinds(figure: Figure, title: str) -> np.ndarray:
    """What a map shows at (sample, position), by the colours of its spans."""
    axis = next(axis for axis in figure.axes if axis.get_title(loc="left").startswith(title))
    (left, right), (bottom, _) = axis.get_xlim(), axis.get_ylim()
    found = np.full((round(bottom + 0.5), round(right - left)), -1)
    for spans in axis.collections:
        (kind,) = [
            number
            for number, ink in enumerate(COLOURS)
            if same_color(ink, spans.get_facecolor()[0])
        ]
        for path in spans.get_paths():
            box = path.get_extents()
            found[round((box.y0 + box.y1) / 2), round(box.x0 - left) : round(box.x1 - left)] = kind
    return found


def test_samples_have_a_column_each_and_say_what_they_reuse(
    drawn: Drawn, side_by_side: Figure
) -> None:
    (dataset, batch), figure = drawn, side_by_side
    # Three views, force, A-scan, state in deg and mm, action in mm, deg and gripper.
    assert len(figure.axes) == 3 * 10
    title = figure.axes[1].get_title()
    assert f"tick 20 of {len(dataset)}" in title
    assert "reuses VL row 6,\n2 ticks old" in title
    assert f"{1000 * float(batch.feature_age[1]):.0f} ms old" in title


def test_samples_count_time_as_the_other_pictures_do(drawn: Drawn, view: EpisodeView) -> None:
    dataset, batch = drawn
    assert view.timeline is not None
    first = float(view.timeline.time[0]) - view.zero
    assert first > 0.01
    axis = recording.samples(dataset, batch, view.zero).axes[0]
    assert f"\nat {first:.2f} s\n" in axis.get_title()


def test_a_state_without_a_unit_has_no_blank_before_its_comma(drawn: Drawn) -> None:
    dataset, batch = drawn
    store = dataset.store
    named = {"names": ["joint_1", "joint_2"], "units": ["", ""]}
    like = SimpleNamespace(
        streams=store.streams | {"state": named},
        episodes=store.episodes,
        vlm_reuse_count=store.vlm_reuse_count,
    )
    two = replace(batch, state=batch.state[:, :, :2])
    figure = recording.samples(SimpleNamespace(store=like), two, 0.0)  # pyright: ignore[reportArgumentType]
    said = [axis.get_ylabel().split("\n")[0] for axis in figure.axes]
    assert "state," in said


def test_what_samples_have_in_common_is_said_once(
    drawn: Drawn, side_by_side: Figure, words_of: Callable[[Figure], str]
) -> None:
    (dataset, batch), figure = drawn, side_by_side
    assert figure.get_suptitle().splitlines()[1] == f"“{batch.instruction[0]}”"
    assert words_of(figure).count(batch.instruction[0]) == 1
    other = replace(batch, instruction=["one", "two", "a sentence of more words than a column"])
    figure = recording.samples(dataset, other, 0.0)
    assert not figure.get_suptitle()
    titles = [axis.get_title().splitlines()[1] for axis in figure.axes[:3]]
    assert titles[:2] == ["“one”", "“two”"]
    assert titles[2].startswith("“a sentence of") and titles[2].endswith("…")


def test_five_samples_are_read_at_the_width_of_a_page(drawn: Drawn) -> None:
    dataset, _ = drawn
    five = unified_collate_fn([dataset[at] for at in range(5)])
    figure = recording.samples(dataset, five, 0.0)
    figure.draw_without_rendering()
    smallest = min(text.get_fontsize() for text in figure.findobj(Text) if text.get_text())
    assert smallest / 72 * 720 / figure.get_figwidth() >= 8
    titles = [axis.title.get_window_extent() for axis in figure.axes[:5]]
    assert all(left.x1 < right.x0 for left, right in pairwise(titles))


def test_the_maps_of_a_batch_are_drawn_without_images_and_name_the_views(
    batch_map: Figure,
) -> None:
    assert not any(axis.images for axis in batch_map.axes)
    frames = batch_map.axes[3]
    assert [label.get_text() for label in frames.get_xticklabels()] == ["View1", "View2", "View5"]
    assert frames.get_title(loc="left") == "frames"


def test_padding_and_masked_steps_are_hatched(drawn: Drawn, side_by_side: Figure) -> None:
    (_, batch), figure = drawn, side_by_side
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
    missing = replace(
        batch,
        sensor_valid=torch.zeros(3, dtype=torch.int64),
        images=[{}, *(batch.images or [])[1:]],
    )
    said = words_of(recording.samples(dataset, missing, 0.0))
    assert said.count("sensor missing") == 6
    assert said.count("view missing") == 3
    mapped = recording.batch(missing)
    assert (kinds(mapped, "sensor window") == MISSING).all()
    assert (kinds(mapped, "frames")[0] == MISSING).all()
    without = replace(
        batch, state=torch.zeros(3, 20, 0), state_valid=torch.zeros(3, dtype=torch.int64)
    )
    assert "not in this data set" in words_of(recording.batch(without))


def test_the_map_of_a_batch_tells_real_from_padded_and_masked(
    drawn: Drawn, batch_map: Figure
) -> None:
    (_, batch), figure = drawn, batch_map
    sensor = kinds(figure, "sensor window")
    assert sensor.shape == (3, 65)
    assert (sensor == REAL).sum(axis=1).tolist() == batch.sensor_valid.tolist()
    assert sensor[0, 0] == PADDED
    assert sensor[0, -1] == REAL
    assert kinds(figure, "action chunk")[2].tolist() == [REAL, MASKED, MASKED, MASKED]


def test_the_same_samples_are_the_same_bytes(drawn: Drawn) -> None:
    dataset, _ = drawn
    one = unified_collate_fn([dataset[20]])
    for draw in (lambda: recording.samples(dataset, one, 0.0), lambda: recording.batch(one)):
        written = [io.BytesIO(), io.BytesIO()]
        for stream in written:
            draw().savefig(stream, format="svg", metadata={"Date": None})
        assert written[0].getvalue() == written[1].getvalue()
