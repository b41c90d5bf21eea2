"""The page of rollouts says how they ended, for any number of episodes, and a browser shows it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.base.table import Table
from pipeline.evaluate.rollouts import RolloutEpisode, Rollouts
from pipeline.look.page.blocks import Document, Picture, Report, Text
from pipeline.look.page.writing import PAGE, write_report
from pipeline.look.rollout.page import rollout_report, worst_and_median

Sound = Callable[[Path], None]
MakeEpisode = Callable[..., RolloutEpisode]
MakeRollouts = Callable[..., Rollouts]
ALWAYS = {"paths", "courses", "filmstrip_worst"}


def failure(make_episode: MakeEpisode, seed: int = 0, **changed: object) -> RolloutEpisode:
    ended = {"success": False, "reason": "time is up", "depth_mm": 1.5}
    return make_episode(seed, **ended | changed)


def pictures_of(report: Report) -> set[str]:
    return {picture.name for picture in report.blocks(Picture)}


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
    (settings,) = report.blocks(Document)
    assert settings.content["chunking"] == "none"
    assert_page_is_sound(tmp_path / PAGE)


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


def test_the_worst_fails_and_the_median_lies_in_the_middle(make_episode: MakeEpisode) -> None:
    far_but_inserted = make_episode(1, lateral_mm=0.9, depth_mm=-0.1)
    inserted = make_episode(2, lateral_mm=0.1)
    near = failure(make_episode, 3, lateral_mm=0.2, depth_mm=0.3)
    deep = failure(make_episode, 4, lateral_mm=0.0, depth_mm=-0.6)
    beside = failure(make_episode, 5, lateral_mm=3.0, depth_mm=0.0)
    episodes = [inserted, near, beside, far_but_inserted, deep]
    assert worst_and_median(episodes) == (beside, near)
    assert worst_and_median([near]) == (near, near)
    assert worst_and_median([inserted, far_but_inserted]) == (far_but_inserted, inserted)


def test_without_any_success(
    make_episode: MakeEpisode, make_rollouts: MakeRollouts, tmp_path: Path
) -> None:
    episodes = [failure(make_episode, seed, lateral_mm=seed) for seed in range(4)]
    report = rollout_report(make_rollouts(*episodes))
    assert dict(report.tiles)["success of the policy"] == "0% (0% to 49%)"
    (success,) = report.blocks(Table)
    assert [row[5] for row in success.rows] == ["4 time is up"]
    assert {file.stem for file in write_report(tmp_path, report)} >= ALWAYS
    worst = next(part for part in report.sections[2].parts if part.title.startswith("Worst"))
    (words,) = (block.words for block in worst.blocks if isinstance(block, Text))
    assert words.startswith(
        "Time is up. 3.00 mm sideways from the target at the puncture, 1.50 mm short of "
    )


def test_a_single_episode_is_shown_once(
    make_episode: MakeEpisode, make_rollouts: MakeRollouts, tmp_path: Path
) -> None:
    """And of one tick alone, as where the first observation stops it."""
    report = rollout_report(make_rollouts(make_episode(7, ticks=1)))
    assert pictures_of(report) == ALWAYS
    assert len(write_report(tmp_path, report)) == 1 + len(ALWAYS)


def test_names_are_words_and_never_part_of_the_page(
    make_episode: MakeEpisode,
    make_rollouts: MakeRollouts,
    tmp_path: Path,
    assert_page_is_sound: Sound,
) -> None:
    reason = "safe stop: <script>alert(1)</script> & $x_1$"
    stopped = failure(make_episode, reason=reason)
    other = make_episode(1, controller="<b>off</b>")
    named = make_rollouts(stopped, other)
    write_report(tmp_path, rollout_report(replace(named, checkpoint="models/<i>head</i>")))
    page = (tmp_path / PAGE).read_text()
    assert "<script>alert" not in page and "<i>head" not in page and "<b>off" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; $x_1$" in page
    assert_page_is_sound(tmp_path / PAGE)


def test_the_same_rollouts_are_the_same_bytes(rollouts: Rollouts, tmp_path: Path) -> None:
    first, second = (
        [file.read_bytes() for file in write_report(tmp_path / name, rollout_report(rollouts))]
        for name in ("first", "second")
    )
    assert first == second
