"""Pictures to zoom tell each mark's index and time, and stay small however long the recording."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pipeline.look.recording import draw_interactive as interactive
from pipeline.look.recording.facts import Clock, EpisodeView, Gap


def test_hovering_tells_frames_rows_and_ticks(view: EpisodeView, clocks: tuple[Clock, ...]) -> None:
    figure = interactive.clock_lanes(view, clocks)
    lanes = {trace.name: trace for trace in figure.data}
    assert view.timeline is not None
    assert len(lanes["View1"].x) == len(view.cameras["View1"].time)
    np.testing.assert_allclose(lanes["ticks"].x, view.timeline.time - view.zero)
    assert lanes["ticks"].text[4] == "tick 4, reuses VL row 1, ticks since: 1"
    row = view.timeline.frames["View2"][2]
    assert f"View2: frame {row}, " in lanes["VL rows"].text[2]
    took = lanes["frames of View2 that VL rows took"]
    assert took.x[6] == pytest.approx(view.timeline.frame_time["View2"][2] - view.zero)
    assert np.isnan(took.x[8])
    gap = clocks[4].gaps[0]
    assert lanes["gaps of state, poses"].x[0] == pytest.approx(gap.start_s - view.zero)


def test_names_are_no_markup(view: EpisodeView, clocks: tuple[Clock, ...]) -> None:
    line = view.timeline
    assert line is not None
    renamed = replace(
        line,
        frames={"<b>x</b>": line.frames["View1"]},
        frame_time={"<b>x</b>": line.frame_time["View1"]},
    )
    gap = Gap(float(clocks[0].time[3]), float(clocks[0].time[4]))
    named = (
        replace(clocks[0], name="<b>x</b>", gaps=(gap,)),
        replace(clocks[3], name="<i>s</i>"),
        *clocks[-2:],
    )
    figure = interactive.clock_lanes(replace(view, timeline=renamed), named)
    text = str(figure.to_dict())
    assert "&lt;b&gt;x&lt;/b&gt;: frame " in text and "frames of &lt;b&gt;x" in text
    assert "<b>" not in text and "<i>" not in text


def test_a_page_may_set_its_own_colours(view: EpisodeView, clocks: tuple[Clock, ...]) -> None:
    layout = interactive.clock_lanes(view, clocks).layout
    assert layout.paper_bgcolor == layout.plot_bgcolor == "rgba(0, 0, 0, 0)"
    assert layout.font.color is None
    assert layout.title.text is None


def test_a_long_recording_stays_small_and_says_what_it_leaves_out(
    view: EpisodeView, clocks: tuple[Clock, ...]
) -> None:
    hour = np.arange(3600 * 10) / 10
    readings = np.arange(3600 * 650) / 650
    long = (
        replace(clocks[0], name="View1", time=hour, gaps=()),
        replace(clocks[3], time=readings),
    )
    figure = interactive.clock_lanes(replace(view, timeline=None, zero=0.0), long)
    assert len(figure.to_json()) < 1_000_000
    assert "View1, 1 of 9" in figure.layout.yaxis.ticktext
    assert max(len(trace.x) for trace in figure.data) <= interactive.SINGLE


def test_the_same_clocks_are_the_same_figure(view: EpisodeView, clocks: tuple[Clock, ...]) -> None:
    one, two = (interactive.clock_lanes(view, clocks).to_json() for _ in range(2))
    assert one == two


def test_the_line_below_the_axis_has_room_on_a_phone(
    view: EpisodeView, clocks: tuple[Clock, ...]
) -> None:
    line = interactive.clock_lanes(view, clocks).layout.xaxis.title.text.split("<br>")[1]
    # At 390 pixels beside names of lanes; its signs are 6 pixels wide.
    assert len(re.sub("<[^>]*>", "", line)) <= 45
