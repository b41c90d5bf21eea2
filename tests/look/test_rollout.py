"""The page of rollouts says how they ended, for any number of episodes, and a browser shows it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.text import Table
from pipeline.evaluate.rollouts import InsertionTrace, RolloutEpisode, Rollouts
from pipeline.look.page.blocks import Outline, Picture, Report, Text
from pipeline.look.page.writing import PAGE, write_report
from pipeline.look.rollout import (
    draw_courses,
    draw_filmstrip,
    draw_latency,
    draw_paths,
    rollout_report,
    worst_and_median,
)
from pipeline.simulation.insertion import FORCE_LIMIT_N, MISS_MM

Sound = Callable[[Path], None]
ALWAYS = {"paths", "courses", "filmstrip_worst"}


VIEWS = ("View1", "View2")
ENDINGS = ("time is up", "punctured beside the target", "safe stop: the sensor stalled")


def frames(time_s: float) -> dict[str, np.ndarray]:
    shade = np.uint8(min(255, 20 * time_s))
    return {view: np.full((126, 224, 3), shade, np.uint8) for view in VIEWS}


def rollout_episode(seed: int = 0, ticks: int = 60, **changed: Any) -> RolloutEpisode:
    """The needle comes down on a straight line, from another side with every seed."""
    part = np.linspace(0, 1, ticks)
    miss = 0.2 + 0.1 * (seed % 5)
    way = (6 * (1 - part) + miss)[:, None] * [np.cos(seed), np.sin(seed)]
    height = 4 - 6.5 * part
    trace = InsertionTrace(
        time_s=0.1 * np.arange(1, ticks + 1),
        offset_mm=way,
        lateral_mm=way[-1],
        height_mm=height,
        layer_mm=height + 2.5,
        force_n=np.where(height < 0, 0.6, 0.0),
    )
    given = {
        "controller": "policy", "seed": seed, "level": "full", "success": True,
        "reason": "inserted", "lateral_mm": miss, "depth_mm": 0.05, "overshoot_mm": 0.1,
        "max_force_n": 0.6, "time_s": 0.1 * ticks, "ticks": ticks, "trace": trace,
        "frames": frames,
    }  # fmt: skip
    return RolloutEpisode(**given | changed)


def failed(seed: int = 0, **changed: Any) -> RolloutEpisode:
    """An episode that ends short of the layer."""
    reason = ENDINGS[seed % len(ENDINGS)]
    return rollout_episode(seed, **{"success": False, "reason": reason, "depth_mm": 1.5} | changed)


def rollouts_of(*episodes: RolloutEpisode) -> Rollouts:
    settings = {"execute": 1, "chunking": "none", "latency_ms": 0, "seed": 1000000}
    return Rollouts("models/head", settings, episodes)


@pytest.fixture(scope="session")
def rollouts() -> Rollouts:
    """Five episodes of every controller: the demonstrator always succeeds."""
    return rollouts_of(
        *(rollout_episode(seed) if seed < 3 else failed(seed) for seed in range(5)),
        *(rollout_episode(seed, controller="expert") for seed in range(5)),
        *(failed(seed, controller="features off", lateral_mm=40.0) for seed in range(5)),
    )


def failure(seed: int = 0, **changed: object) -> RolloutEpisode:
    return failed(seed, **{"reason": "time is up"} | changed)


def drawn(report: Report) -> set[str]:
    """The names of the pictures of a report, which can all be drawn."""
    return {picture.name for picture in report.blocks(Picture) if picture.draw()}


def test_every_section_is_there_and_the_page_is_sound(
    rollouts: Rollouts, tmp_path: Path, assert_page_is_sound: Sound
) -> None:
    report = rollout_report(rollouts)
    assert [section.title for section in report.sections] == [
        "Success",
        "Where the needle went",
        "Episodes closely",
        "What was run",
    ]
    files = write_report(tmp_path, report)
    assert {file.stem for file in files} == {"report", "filmstrip_median", *ALWAYS}
    again = write_report(tmp_path / "again", rollout_report(rollouts))
    assert [file.read_bytes() for file in again] == [file.read_bytes() for file in files]
    (settings,) = report.blocks(Outline)
    assert settings.content["chunking"] == "none"
    assert_page_is_sound(tmp_path / PAGE)


def test_several_latencies_are_drawn() -> None:
    late = [failed(seed, controller="300 ms late") for seed in range(2)]
    both = rollouts_of(rollout_episode(0), rollout_episode(1), *late)
    both = replace(both, settings=both.settings | {"latency_ms": [0, 300]})
    report = rollout_report(both)
    assert [section.title for section in report.sections][1] == "A late model"
    (axis,) = draw_latency(both.by_latency()).axes
    (line,) = axis.lines[:1]
    np.testing.assert_array_equal(line.get_xydata(), [[0, 100], [300, 0]])
    assert "latency" in drawn(report)


def test_figures_are_those_of_the_rollouts(rollouts: Rollouts) -> None:
    report = rollout_report(rollouts)
    (success,) = report.blocks(Table)
    policy = "60% (23% to 88%)"
    assert [row[:3] for row in success.rows] == [
        ("policy", policy, 5),
        ("demonstrator", "100% (57% to 100%)", 5),
        ("policy, features off", "0% (0% to 43%)", 5),
    ]
    assert [row[3] for row in success.rows] == pytest.approx([0.4, 0.4, 40.0])
    failed = [row[5] for row in success.rows]
    assert failed[1] == "" and failed[0].startswith("1 ") and failed[2].startswith("2 time is up")
    assert f"policy {policy}; demonstrator 100% (57% to 100%);" in report.summary
    assert dict(report.tiles)["success of the policy"] == policy


def test_the_worst_fails_and_the_median_lies_in_the_middle() -> None:
    far_but_inserted = rollout_episode(1, lateral_mm=0.9, depth_mm=-0.1)
    inserted = rollout_episode(2, lateral_mm=0.1)
    near = failure(3, lateral_mm=0.2, depth_mm=0.3)
    deep = failure(4, lateral_mm=0.0, depth_mm=-0.6)
    beside = failure(5, lateral_mm=3.0, depth_mm=0.0)
    episodes = [inserted, near, beside, far_but_inserted, deep]
    assert worst_and_median(episodes) == (beside, near)
    assert worst_and_median([near]) == (near, near)
    assert worst_and_median([inserted, far_but_inserted]) == (far_but_inserted, inserted)


def test_without_any_success() -> None:
    episodes = [failure(seed, lateral_mm=seed) for seed in range(4)]
    report = rollout_report(rollouts_of(*episodes))
    assert dict(report.tiles)["success of the policy"] == "0% (0% to 49%)"
    (success,) = report.blocks(Table)
    assert [row[5] for row in success.rows] == ["4 time is up"]
    assert drawn(report) >= ALWAYS
    worst = next(part for part in report.sections[2].parts if part.title.startswith("Worst"))
    (words,) = (block.words for block in worst.blocks if isinstance(block, Text))
    assert words.startswith(
        "Time is up. 3.00 mm sideways from the target at the puncture, 1.50 mm short of "
    )


def test_a_single_episode_is_shown_once() -> None:
    """And of one tick alone, as where the first observation stops it."""
    report = rollout_report(rollouts_of(rollout_episode(7, ticks=1)))
    assert drawn(report) == ALWAYS


def test_names_are_words_and_never_part_of_the_page(tmp_path: Path) -> None:
    reason = "safe stop: <script>alert(1)</script> & $x_1$"
    stopped = failure(reason=reason)
    other = rollout_episode(1, controller="<b>off</b>")
    named = rollouts_of(stopped, other)
    write_report(tmp_path, rollout_report(replace(named, checkpoint="models/<i>head</i>")))
    page = (tmp_path / PAGE).read_text()
    assert "<script>alert" not in page and "<i>head" not in page and "<b>off" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; $x_1$" in page


def test_points_of_paths_are_coloured_by_success(rollouts: Rollouts) -> None:
    figure = draw_paths(rollouts)
    titles = [axis.get_title() for axis in figure.axes]
    assert titles == [
        "policy: whole paths",
        "demonstrator: whole paths",
        "policy: the last 3 mm",
        "demonstrator: the last 3 mm",
    ]
    inserted, others = (len(points.get_offsets()) for points in figure.axes[0].collections)
    assert (inserted, others) == (3, 2)
    near, limit = figure.axes[2], MISS_MM
    circle = next(line for line in near.lines if "from the target" in str(line.get_label()))
    assert np.hypot(*circle.get_xydata().T) == pytest.approx(np.full(91, limit))
    # From above, a path begins where it last comes near.
    begins = [np.abs(line.get_xydata()[1:]).max() for line in near.lines[:5]]
    assert max(begins) <= 3.0
    without = replace(rollouts, episodes=rollouts.of("policy"))
    assert len(draw_paths(without).axes) == 2


def test_a_filmstrip_asks_for_frames_at_its_moments() -> None:
    asked = list[float]()

    def frames(time_s: float) -> dict[str, np.ndarray]:
        asked.append(time_s)
        return {"View1": np.zeros((126, 224, 3), np.uint8)}

    episode = rollout_episode(ticks=60, frames=frames)
    figure = draw_filmstrip(episode, "Worst")
    assert len(asked) == 8
    assert (asked[0], asked[-1]) == (episode.trace.time_s[0], episode.trace.time_s[-1])
    assert [axis.get_title() for axis in figure.axes[:8]] == [f"{at:.1f} s" for at in asked]


def test_worst_and_median_stand_out_among_all() -> None:
    episodes = [rollout_episode(seed) for seed in range(6)]
    figure = draw_courses(episodes, {"worst, seed 2": episodes[2], "median, seed 4": episodes[4]})
    assert len(figure.axes) == 4
    for axis in figure.axes:
        strong = [line for line in axis.lines if line.get_linewidth() == 2.4]
        assert [line.get_label() for line in strong] == ["worst, seed 2", "median, seed 4"]
        assert len(axis.lines) == 6 + 2 + 1
    force = figure.axes[-1]
    assert force.lines[0].get_ydata().max() == 0.6
    assert force.lines[-1].get_ydata()[0] == FORCE_LIMIT_N
