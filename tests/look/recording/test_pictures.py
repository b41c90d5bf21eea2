"""What pictures of a recording show lies where and when it was recorded."""

import io
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from pipeline.base.config import Params
from pipeline.data import Channels, Stream
from pipeline.look.page.blocks import Picture, Text
from pipeline.look.recording.cameras import camera_blocks, draw_views
from pipeline.look.recording.clocks import Clock, clock_blocks, draw_lanes
from pipeline.look.recording.episode import LoadedRecording
from pipeline.look.recording.streams import (
    contacts,
    draw_motion,
    draw_sensor,
    group_channels,
    motion_blocks,
    sensor_blocks,
    statistics_blocks,
)

PARAMS = Params.model_validate(
    {
        "data": {"sources": [{"name": "s", "path": "."}]},
        "vlm": {"checkpoint": "none"},
        "inspect": {"samples": 1},
    }
)
Felt = Callable[..., LoadedRecording]


def test_views_are_shown_at_ticks_with_the_age_of_each_frame(view: LoadedRecording) -> None:
    assert view.timeline is not None
    figure = draw_views(view, [3, 5])
    assert [len(axis.images) for axis in figure.axes] == [1] * 6
    at, clock = view.timeline.time[3], view.cameras["View1"].time
    age = at - clock[clock <= at][-1]
    assert figure.axes[0].get_xlabel() == f"{1000 * age:.0f} ms old"


def test_a_view_that_is_not_shown_is_said(copied, look, draw) -> None:
    folder = copied("raw")
    for path in (folder / "View2").iterdir():
        path.write_bytes(b"no picture")
    text, _ = camera_blocks(look(folder), draw, PARAMS)
    assert isinstance(text, Text) and text.words.startswith("view View2 is not shown: ")


def test_contact_is_marked_over_the_force_and_over_the_scan(view: LoadedRecording) -> None:
    force, scan = draw_sensor(view).axes[:2]
    edges = [at - view.zero for at in contacts(view)[0]]
    span = force.patches[0]
    assert isinstance(span, Rectangle)
    assert [span.get_x(), span.get_x() + span.get_width()] == pytest.approx(edges)
    assert [line.get_xdata()[0] for line in scan.lines[:2]] == pytest.approx(edges)
    left, right, *_ = scan.images[0].get_extent()
    assert view.sensor is not None
    ends = [view.sensor.time[at] - view.zero for at in (0, -1)]
    assert [left, right] == pytest.approx(ends, abs=0.01)


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
        svg = saved(figure, "svg")
        assert b"foo$" in svg or b"bar$" in svg


def test_a_scan_is_blank_where_its_clock_has_a_gap_and_nowhere_else(felt: Felt) -> None:
    names = ("force", *(f"aline_{at}" for at in range(40)))
    time = np.arange(1000) / 100
    time[600:] += 5

    def image(time: np.ndarray) -> np.ndarray:
        values = np.tile(np.arange(len(time))[:, None], 41)
        view = replace(felt(names, ("N", *[""] * 40), time, values), timeline=None)
        return np.asarray(draw_sensor(view).axes[1].images[0].get_array(), float)

    gap = np.isnan(image(time)[0])
    assert gap.mean() == pytest.approx(5 / 15, abs=0.01) and (np.diff(gap) != 0).sum() == 2
    bursts = np.repeat(np.arange(10), 130) + 1.767e9
    assert np.isfinite(image(bursts)).all()


@pytest.fixture
def draw(view: LoadedRecording) -> Callable[..., Picture]:
    """Makes pictures of that episode."""
    return lambda name, caption, draw: Picture(name, caption, lambda: draw(view))


def test_motion_says_from_where_each_joint_moved_and_holds_actions(view: LoadedRecording) -> None:
    joints, _, actions, *_ = draw_motion(view).axes
    assert view.state is not None
    assert joints.lines[0].get_label() == f"joint_1 from {view.state.values[0, 0]:.4g}"
    assert joints.lines[0].get_ydata()[0] == 0
    assert np.isnan(joints.lines[0].get_ydata()).sum() == 1  # the gap of its clock
    assert actions.lines[0].get_drawstyle() == "steps-post"


def test_long_curves_are_bitmaps_that_keep_every_extreme(felt: Felt) -> None:
    time = np.arange(100_000) / 1000
    values = np.zeros((len(time), 1))
    values[12_345], values[80_000] = 7, -3
    (line,) = draw_sensor(felt(("force",), ("N",), time, values)).axes[0].lines
    assert line.get_rasterized()
    assert (max(line.get_ydata()), min(line.get_ydata())) == (7, -3)


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


def test_lines_lead_from_the_frame_to_its_row_and_from_there_to_its_ticks(view):
    assert view.timeline is not None
    line, (near,) = view.timeline, draw_lanes(view).axes
    lines = [lines for lines in near.collections if isinstance(lines, LineCollection)]
    # After the strokes of the lanes.
    *took, served = [np.array(ends.get_segments())[..., 0] + view.zero for ends in lines[-4:]]
    for name, ends in zip(("View1", "View2", "View5"), took, strict=True):
        rows = np.searchsorted(line.vl_time, ends[:, 1] - 1e-6)
        assert ends[:, 0] == pytest.approx(line.frame_time[name][rows])
    ticks = np.searchsorted(line.time, served[:, 1] - 1e-6)
    assert served[:, 0] == pytest.approx(line.vl_time[line.vl_row[ticks]])


def test_without_ticks_lanes_are_drawn_and_without_streams_nothing(view, draw) -> None:
    (axis,) = draw_lanes(replace(view, timeline=None)).axes
    assert len(axis.get_yticks()) == 5
    absent = {"cameras": {}, "sensor": None, "state": None, "poses": None, "action": None}
    empty = replace(view, timeline=None, **absent)
    for blocks in (camera_blocks, sensor_blocks, motion_blocks, clock_blocks, statistics_blocks):
        assert blocks(empty, draw, PARAMS) == []


def test_channels_of_one_unit_share_a_panel_and_profiles_and_grippers_are_apart() -> None:
    names = (*(f"aline_{at:04d}" for at in range(40)), "force", "gripper", "joint_0", "pose_x")
    groups = group_channels(Channels(names, (*[""] * 40, "N", "", "deg", "deg")))
    assert [(one.label, len(one.indices), one.profile) for one in groups] == [
        ("force [N]", 1, ""),
        ("gripper", 1, ""),
        ("[deg]", 2, ""),
        ("aline", 40, "aline"),
    ]


def saved(figure: Figure, format: str) -> bytes:
    """A file of it, of few pixels, without the layout that takes most of the time."""
    figure.set_layout_engine("none")
    stream = io.BytesIO()
    figure.savefig(stream, format=format, dpi=30)
    return stream.getvalue()


@pytest.mark.parametrize("channels", [2, 26, 64])
def test_many_channels_share_panels_of_few_and_no_name_is_long(felt: Felt, channels: int) -> None:
    """A limb stays together: two arms of seven joints, two hands of six fingers."""
    arm = [f"{side}_joint_{number}" for side in ("left", "right") for number in range(7)]
    hand = [f"{side}_hand_thumb_rotation_{n}" for side in ("left", "right") for n in range(6)]
    legs = [f"{leg}_{joint}" for leg in "stuvwxyz" for joint in "abcdefgh"]
    names = (arm + hand if channels == 26 else legs)[:channels]
    time = np.arange(50) / 10
    values = np.zeros((50, channels))
    figure = draw_sensor(felt(tuple(names), ("rad",) * channels, time, values))
    drawn = [[line.get_label() for line in axis.lines] for axis in figure.axes]
    assert [name for panel in drawn for name in panel] == names
    assert len(drawn) == {2: 1, 26: 4, 64: 8}[channels]
    for panel in drawn if channels == 26 else ():
        assert len({name[:5] for name in panel}) == 1
    for axis in figure.axes:
        assert all(len(text.get_text()) < 26 for text in axis.get_legend().get_texts())
