"""What pictures of a recording show lies where and when it was recorded."""

import io
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from pipeline.base.channels import unnumbered
from pipeline.data import Channels, Stream
from pipeline.look.recording import pictures as recording
from pipeline.look.recording.draw_channels import groups
from pipeline.look.recording.draw_lanes import BAND
from pipeline.look.recording.draw_thinning import columns, curve, worst_steps
from pipeline.look.recording.facts import Clock, Contact, EpisodeView, Flaw, Gap

Felt = Callable[..., EpisodeView]
Words = Callable[[Figure], str]


def test_views_are_rows_and_ticks_columns_with_the_age_of_each_frame(
    view: EpisodeView, words_of: Words
) -> None:
    assert view.timeline is not None
    frame = np.zeros((9, 16, 3), np.uint8)
    frames = {name: [frame, frame] for name in ("View1", "View2")}
    broken = Flaw("unreadable", "error", "demo", "e", "view View7", None, None, "cut short")
    shown = replace(view, flaws=(broken,))
    figure = recording.camera_views(shown, [3, 5], frames)
    assert len(figure.axes) == 4 * 2  # View1, View2, View5 and the broken one
    assert [axis.get_ylabel() for axis in figure.axes[::2]] == ["View1", "View2", "View5", "View7"]
    assert [len(axis.images) for axis in figure.axes] == [1] * 4 + [0] * 4
    at = view.timeline.time[3]
    clock = view.cameras["View1"].time
    age = at - clock[clock <= at][-1]
    assert figure.axes[0].get_xlabel() == f"{1000 * age:.0f} ms old"
    assert words_of(figure).count("no frame") == 4


def test_contact_is_marked_over_the_force_and_over_the_scan(view: EpisodeView) -> None:
    figure = recording.sensor(view, (Contact(view.zero + 2.0, view.zero + 3.0),))
    force, scan = figure.axes[:2]
    assert force.get_ylabel() == "force [N]"
    (span,) = force.patches
    assert isinstance(span, Rectangle)
    assert (span.get_x(), span.get_x() + span.get_width()) == pytest.approx((2.0, 3.0))
    edges = [line.get_xdata()[0] for line in scan.lines if line.get_linestyle() == "--"]
    assert edges == pytest.approx([2.0, 3.0])
    assert force.get_xlim() == scan.get_xlim()
    (bar,) = scan.child_axes
    assert bar.get_ylabel() == "aline (no unit)"
    left, right, bottom, top = scan.images[0].get_extent()
    assert view.sensor is not None
    assert left == pytest.approx(view.sensor.time[0] - view.zero)
    assert right == pytest.approx(view.sensor.time[-1] - view.zero, abs=0.01)
    assert (bottom, top) == (1024.5, -0.5)


def test_another_sensor_is_curves_by_unit(felt: Felt) -> None:
    time = np.arange(100) / 100
    names = ("fx", "fy", "fz", "tx", "ty", "tz")
    wrench = felt(
        names, ("N",) * 3 + ("Nm",) * 3, time, np.random.default_rng(0).normal(size=(100, 6))
    )
    figure = recording.sensor(wrench, ())
    assert [axis.get_ylabel() for axis in figure.axes] == ["[N]", "[Nm]"]
    assert [len(axis.lines) for axis in figure.axes] == [3, 3]
    one = recording.sensor(felt(("pressure",), ("",), time[:1], np.ones((1, 1))), ())
    assert one.axes[0].get_ylabel() == "pressure"


def test_names_are_written_as_they_are_in_curves_clocks_and_frames(view: EpisodeView) -> None:
    names = ("cost_$5_$6", "$\\foo$", "<b>x</b>", "_hidden", "100%")
    time = np.arange(9) / 9
    stream = Stream(Channels(names, ("$\\bar$",) * 5), time, np.eye(9, 5, dtype=np.float32))
    named = replace(view, sensor=stream, state=stream, poses=None, action=None, timeline=None)
    legends = [axis.get_legend() for axis in recording.motion(named).axes]
    said = {text.get_text().strip() for one in legends if one for text in one.get_texts()}
    assert said == set(names)
    clocks = (Clock("view $\\foo$", "camera", time, 9.0, 0.0, ()),)
    frames = {"$\\foo$": [np.zeros((9, 16, 3), np.uint8)]}
    for figure in (
        recording.motion(named),
        recording.sensor(named, ()),
        recording.clock_lanes(named, clocks),
        recording.clock_steps(clocks),
        recording.camera_views(view, [0], frames),
    ):
        svg, _ = saved(figure)
        assert b"foo$" in svg or b"bar$" in svg


def test_one_reading_of_a_profile_is_drawn_at_a_time_of_day(felt: Felt) -> None:
    names = ("force", *(f"aline_{at}" for at in range(40)))
    one = replace(felt(names, ("N", *[""] * 40), np.array([1.767e9]), np.ones((1, 41))), zero=0.0)
    figure = recording.sensor(one, ())
    figure.draw_without_rendering()
    left, right, _, _ = figure.axes[1].images[0].get_extent()
    assert right - left == pytest.approx(1e-3, rel=0.01)


def test_a_sensor_stamped_in_bursts_has_no_blank_stripes_and_lanes_of_full_height(
    felt: Felt,
) -> None:
    time = np.repeat(np.arange(10), 130) + 1.767e9
    names = ("force", *(f"aline_{at}" for at in range(40)))
    view = felt(names, ("N", *[""] * 40), time, np.ones((len(time), 41)))
    view = replace(view, zero=1.767e9, timeline=None)
    _, scan = recording.sensor(view, ()).axes[:2]
    assert np.isfinite(np.asarray(scan.images[0].get_array(), float)).all()
    shown = (Clock("sensor", "stream", time, 130.0, 0.0, ()),)
    whole, _ = recording.clock_lanes(view, shown).axes
    (band,) = [one for one in whole.collections if one.get_label() == BAND]
    corners = band.get_paths()[0].vertices
    assert np.ptp(corners[:, 1]) == pytest.approx(0.72)
    assert np.unique(corners[:, 1].round(6)).tolist() == [-0.36, 0.36]


def test_what_the_height_of_a_band_means_is_said_where_there_is_one(
    view: EpisodeView, clocks: tuple[Clock, ...]
) -> None:
    def said(shown: Sequence[Clock]) -> str:
        figure = recording.clock_lanes(replace(view, timeline=None), shown)
        return figure.legends[0].get_title().get_text()

    assert said(clocks[:4]) == BAND
    assert said(clocks[:3]) == ""


def test_an_episode_without_a_camera_has_lanes_and_says_so(
    view: EpisodeView, clocks: tuple[Clock, ...], words_of: Words
) -> None:
    blind = replace(view, cameras={})
    assert "no camera" in words_of(recording.camera_views(blind, [0, 3], {}))
    others = [clock for clock in clocks if clock.kind != "camera"]
    whole, _ = recording.clock_lanes(blind, others).axes
    assert [label.get_text() for label in whole.get_yticklabels()] == [
        "sensor", "state, poses", "VL rows", "ticks",
    ]  # fmt: skip


def test_frames_of_any_size_stand_side_by_side(view: EpisodeView) -> None:
    sizes = ((9, 16), (48, 64), (64, 48))
    mixed = [np.full((*size, 3), 7, np.uint8) for size in sizes]
    figure = recording.camera_views(view, [0, 3, 5], {"View1": mixed, "View2": mixed[::-1]})
    figure.draw_without_rendering()
    for axis, (high, wide) in zip(figure.axes[:3], sizes, strict=True):
        assert axis.images[0].get_size() == (high, wide)
        box = axis.get_window_extent()
        assert box.height / box.width == pytest.approx(high / wide, rel=0.02)
    assert figure.axes[0].get_window_extent().y0 > figure.axes[3].title.get_window_extent().y1


def test_a_stream_that_is_not_there_is_said(view: EpisodeView, words_of: Words) -> None:
    empty = replace(
        view, timeline=None, cameras={}, sensor=None, state=None, poses=None, action=None
    )
    assert "no sensor" in words_of(recording.sensor(empty, ()))
    assert "no state, no poses and no actions" in words_of(recording.motion(empty))
    assert "No ticks" in words_of(recording.camera_views(empty, [], {}))
    assert "no clock" in words_of(recording.clock_lanes(empty, ()))
    assert "no clock" in words_of(recording.clock_steps(()))


def test_motion_says_from_where_each_joint_moved_and_holds_actions(view: EpisodeView) -> None:
    figure = recording.motion(view)
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels == [
        "change of joint [deg]", "change of pose [mm]", "change of pose [deg]",
        "[mm]", "[deg]", "gripper",
    ]  # fmt: skip
    assert view.state is not None
    first = view.state.values[0, 0]
    assert figure.axes[0].lines[0].get_label() == f"joint_1 from {first:.4g}"
    assert figure.axes[0].lines[0].get_ydata()[0] == 0
    assert figure.axes[3].lines[0].get_drawstyle() == "steps-post"
    assert np.isnan(figure.axes[0].lines[0].get_ydata()).sum() == 1  # the gap of its clock


def test_lanes_show_every_clock_once_with_its_gap(
    view: EpisodeView, clocks: tuple[Clock, ...]
) -> None:
    whole, near = recording.clock_lanes(view, clocks).axes
    names = [label.get_text() for label in whole.get_yticklabels()]
    assert names == ["sensor", "state, poses", "View1", "View2", "View5", "VL rows", "ticks"]
    gap = clocks[4].gaps[0]
    for axis in (whole, near):
        (gaps,) = [one for one in axis.collections if one.get_hatch() and one.get_paths()]
        (box,) = (path.get_extents() for path in gaps.get_paths())
        assert (box.x0, box.x1) == pytest.approx((gap.start_s - view.zero, gap.stop_s - view.zero))
    assert near.get_xlim()[0] < gap.start_s - view.zero < near.get_xlim()[1]


def test_many_gaps_are_one_artist_and_the_longest_have_words(view: EpisodeView) -> None:
    time = np.cumsum(np.where(np.arange(4000) % 4, 0.1, 0.5 + np.arange(4000) / 4000))
    gaps = tuple(Gap(float(time[at - 1]), float(time[at])) for at in range(4, 4000, 4))
    clocks = [Clock("View1", "camera", time, 5.0, 0.0, gaps)]
    whole, _ = recording.clock_lanes(replace(view, timeline=None, zero=0.0), clocks).axes
    (drawn,) = [one for one in whole.collections if one.get_hatch()]
    assert len(drawn.get_paths()) == 999 and not whole.patches[1:]
    said = [text.get_text() for text in whole.texts if text.get_text().endswith(" s")]
    assert said == ["1.5 s"] * 8


def test_lines_lead_from_the_frame_to_its_row_and_brackets_to_its_ticks(
    view: EpisodeView, clocks: tuple[Clock, ...]
) -> None:
    assert view.timeline is not None
    line, (_, near) = view.timeline, recording.clock_lanes(view, clocks).axes
    said = [text.get_text() for text in near.texts if "row" in text.get_text()]
    row = int(said[0].split()[1].rstrip(","))
    took = [
        one for one in near.collections
        if isinstance(one, LineCollection) and str(one.get_label()).startswith("took")
    ]  # fmt: skip
    assert [one.get_label() for one in took] == ["took View1", "took View2", "took View5"]
    ends = [tuple(segment[0]) for segment in took[0].get_segments()]
    assert any(x == pytest.approx(line.frame_time["View1"][row] - view.zero) for x, _ in ends)
    served = line.time[line.vl_row == row] - view.zero
    brackets = [one.get_xdata() for one in near.lines if len(one.get_xdata()) == 4]
    assert any(
        (one[0], one[-1]) == (pytest.approx(served[0]), pytest.approx(served[-1]))
        for one in brackets
    )


def test_lanes_without_ticks_are_drawn(view: EpisodeView, clocks: tuple[Clock, ...]) -> None:
    without = [clock for clock in clocks if clock.kind in ("camera", "stream")]
    whole, _ = recording.clock_lanes(replace(view, timeline=None), without).axes
    assert len(whole.get_yticks()) == 5


def test_steps_beyond_a_histogram_are_counted(clocks: tuple[Clock, ...]) -> None:
    figure = recording.clock_steps(clocks)
    state = next(axis for axis in figure.axes if axis.get_title() == "state, poses")
    gap = clocks[4].gaps[0]
    assert [text.get_text().strip() for text in state.texts] == [
        f"1, up to {1000 * (gap.stop_s - gap.start_s):.4g} ms"
    ]
    assert sum(bar.get_height() for bar in state.patches) == len(clocks[4].time) - 2


def test_steps_beyond_both_edges_are_one_entry_of_the_legend() -> None:
    steps = np.full(100, 0.1)
    steps[20], steps[50] = 0.01, 0.5
    uneven = Clock("View1", "camera", np.cumsum(steps), 10.0, 0.0, ())
    even = Clock("state", "stream", np.arange(100) / 10, 10.0, 0.0, ())
    for shown in ((uneven, even), (even, uneven)):
        said = [text.get_text() for text in recording.clock_steps(shown).legends[0].get_texts()]
        assert said == ["steps", "median", "steps beyond the panel"]


def test_a_long_stream_keeps_its_extremes_and_its_gaps() -> None:
    time = np.arange(100_000) / 1000
    time[60_000:] += 5.0
    values = np.zeros((len(time), 1), np.float32)
    values[12_345], values[80_000] = 7, -3
    shown = curve(time, values)
    assert shown.bin_s is not None
    assert len(shown.time) < 5000
    assert (np.nanmax(shown.values), np.nanmin(shown.values)) == (7, -3)
    assert np.isnan(shown.values).any()
    edges, image = columns(time, values)
    empty = np.isnan(image[0])
    assert empty.any()
    assert edges[:-1][empty].min() > 59.9
    assert edges[:-1][empty].max() < 65.1


def test_sparse_readings_are_held_until_the_next() -> None:
    edges, image = columns(np.array([0.0, 1.0, 2.0]), np.array([[1], [2], [3]], np.float32), 30)
    np.testing.assert_array_equal(np.unique(image), [1, 2, 3])
    np.testing.assert_array_equal(image[0], 1 + np.floor(edges[:-1] + 1e-9))


def test_columns_are_means_and_a_clock_in_packets_has_no_holes() -> None:
    time = np.repeat(np.arange(100) / 10, 65)
    values = np.arange(len(time), dtype=np.float32)[:, None]
    shown = curve(time, values)
    assert not np.isnan(shown.values).any()
    _, image = columns(time, values, 500)
    assert not np.isnan(image).any()
    assert image[0, 0] == values[:65].mean()


def test_a_lost_entry_is_the_longest_step_of_its_bins_alone() -> None:
    time = np.delete(np.arange(100) / 10, 50)
    steps = worst_steps(time, np.linspace(time[0], time[-1], 34))
    assert (steps > 0.15).sum() in (1, 2)
    assert steps[16] == pytest.approx(0.2)


def test_profiles_and_grippers_are_apart() -> None:
    names = ("force", *(f"aline_{at:04d}" for at in range(40)), "gripper", "joint_0_vel")
    found = groups(Channels(names, ("N", *[""] * 42)))
    assert [(one.name, one.unit, len(one.indices), one.is_profile) for one in found] == [
        ("", "N", 1, False),
        ("aline", "", 40, True),
        ("gripper", "", 1, False),
        ("joint_vel", "", 1, False),
    ]


def test_channels_that_a_number_tells_apart_share_a_name() -> None:
    assert unnumbered("aline_0012") == unnumbered("aline_7") == "aline_#"
    assert unnumbered("joint_1_vel") != unnumbered("joint_1_pos")
    assert unnumbered("force") == "force"


def test_the_same_recording_is_the_same_bytes(view: EpisodeView, clocks: tuple[Clock, ...]) -> None:
    frame = np.zeros((9, 16, 3), np.uint8)
    frames = {name: [frame, frame] for name in view.cameras}
    touching = (Contact(view.zero + 2.0, view.zero + 3.0),)
    draws: tuple[Callable[[], Figure], ...] = (
        lambda: recording.camera_views(view, [3, 5], frames),
        lambda: recording.sensor(view, touching),
        lambda: recording.motion(view),
        lambda: recording.clock_lanes(view, clocks),
        lambda: recording.clock_steps(clocks),
    )
    for draw in draws:
        assert saved(draw()) == saved(draw())


def saved(figure: Figure) -> tuple[bytes, bytes]:
    """As SVG, and as a PNG of few pixels."""
    svg, png = io.BytesIO(), io.BytesIO()
    figure.savefig(svg, format="svg", metadata={"Date": None})
    # Where everything lies is settled: it need not be found again for the other format.
    figure.set_layout_engine("none")
    figure.savefig(png, format="png", dpi=30, metadata={"Software": None})
    return svg.getvalue(), png.getvalue()
