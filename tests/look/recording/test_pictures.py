"""What pictures of a recording show lies where and when it was recorded."""

import io
from dataclasses import replace

import numpy as np
import pytest

from pipeline.data import Channels, Stream
from pipeline.look.recording.cameras import camera_blocks, draw_views
from pipeline.look.recording.clocks import Clock, clock_blocks, draw_lanes
from pipeline.look.recording.episode import LoadedRecording
from pipeline.look.recording.streams import (
    draw_motion,
    draw_sensor,
    motion_blocks,
    sensor_blocks,
    statistics_blocks,
)
from tests.look.recording.conftest import PARAMS


def test_views_are_shown_at_ticks_with_the_age_of_each_frame(view: LoadedRecording) -> None:
    assert view.timeline is not None
    figure = draw_views(view, [3, 5])
    assert [len(axis.images) for axis in figure.axes] == [1] * 6
    at, clock = view.timeline.time[3], view.cameras["View1"].time
    age = at - clock[clock <= at][-1]
    assert figure.axes[0].get_xlabel() == f"{1000 * age:.0f} ms old"


def test_names_are_written_as_they_are(view: LoadedRecording) -> None:
    names = ("cost_$5_$6", "$\\foo$", "<b>x</b>", "_hidden", "100%")
    stream = Stream(
        Channels(names, ("$\\bar$",) * 5), np.arange(9) / 9, np.eye(9, 5, dtype=np.float32)
    )
    bare = {"poses": None, "action": None, "timeline": None, "cameras": {}}
    named = replace(view, sensor=stream, state=stream, **bare)
    legends = [axis.get_legend() for axis in draw_motion(named).axes]
    said = {text.get_text().strip() for one in legends if one for text in one.get_texts()}
    assert said == set(names)
    for figure in (draw_motion(named), draw_sensor(named)):
        figure.set_layout_engine("none")  # it takes most of the time
        figure.savefig(file := io.BytesIO(), format="svg", dpi=30)
        assert b"foo$" in file.getvalue() or b"bar$" in file.getvalue()


def test_lanes_show_every_clock_once_with_its_gap(view: LoadedRecording) -> None:
    (axis,) = draw_lanes(view).axes
    names = [label.get_text() for label in axis.get_yticklabels()]
    views = ["view View1", "view View2", "view View5"]
    assert names == ["sensor", "state, poses", *views, "VL rows", "ticks"]
    assert view.state is not None
    (gap,) = Clock("state", "stream", view.state.time).gaps
    (gaps,) = [one for one in axis.collections if one.get_hatch() and one.get_paths()]
    (box,) = (path.get_extents() for path in gaps.get_paths())
    assert (box.x0, box.x1) == pytest.approx((gap.start_s - view.zero, gap.stop_s - view.zero))
    assert axis.get_xlim()[0] < gap.start_s - view.zero < axis.get_xlim()[1]


def test_without_ticks_lanes_are_drawn_and_without_streams_nothing(view) -> None:
    (axis,) = draw_lanes(replace(view, timeline=None)).axes
    assert len(axis.get_yticks()) == 5
    absent = {"cameras": {}, "sensor": None, "state": None, "poses": None, "action": None}
    empty = replace(view, timeline=None, **absent)
    for blocks in (camera_blocks, sensor_blocks, motion_blocks, clock_blocks, statistics_blocks):
        assert blocks(empty, lambda *_: pytest.fail("draws nothing"), PARAMS) == []
