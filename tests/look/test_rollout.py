"""The page of rollouts says how they ended, for any number of episodes, and a browser shows it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.base.text import Table
from pipeline.evaluate.rollouts import InsertionTrace, RolloutEpisode, Rollouts
from pipeline.look.page.blocks import Outline, Picture, Report
from pipeline.look.page.writing import PAGE, write_report
from pipeline.look.rollout import rollout_report

ALWAYS = {"courses", "filmstrip_worst"}


VIEWS = ("View1", "View2")


def frames(after: Sequence[int]) -> list[dict[str, tuple[float, np.ndarray]]]:
    """Brighter with every action."""
    shades = [np.full((126, 224, 3), min(255, 2 * played), np.uint8) for played in after]
    return [
        dict.fromkeys(VIEWS, (0.1 * played, shade))
        for played, shade in zip(after, shades, strict=True)
    ]


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
        "reason": "inserted", "time_s": 0.1 * ticks, "ticks": ticks, "trace": trace,
        "frames": frames, "actions": ticks - 1,
    }  # fmt: skip
    figures = {"lateral_mm": miss, "depth_mm": 0.05, "overshoot_mm": 0.1, "max_force_n": 0.6}
    figures = {name: changed.pop(name, value) for name, value in figures.items()}
    return RolloutEpisode(**given | changed, figures=figures)


def failed(seed: int = 0, **changed: Any) -> RolloutEpisode:
    """An episode that ends short of the layer."""
    short = {"success": False, "reason": "time is up", "depth_mm": 1.5}
    return rollout_episode(seed, **short | changed)


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


def drawn(report: Report) -> set[str]:
    """The names of the pictures of a report, which can all be drawn."""
    return {picture.name for picture in report.blocks(Picture) if picture.draw()}


def test_every_picture_is_there(rollouts: Rollouts) -> None:
    report = rollout_report(rollouts)
    names = {picture.name for picture in report.blocks(Picture)}
    assert names == {"filmstrip_median", *ALWAYS}
    assert report.verdict == "The policy succeeds in 3 of 5 episodes"
    advice = " ".join(block.words for block in report.sections[-1].blocks)
    assert "features off" not in advice and "time is up (2)" in advice and "more demo" in advice
    assert "rollout.episodes: 200" in advice and "drive" not in advice
    (settings,) = report.blocks(Outline)
    assert settings.content["chunking"] == "none"


@pytest.mark.slow
def test_the_page_is_sound_and_the_same_again(rollouts, tmp_path, assert_page_is_sound):
    files = write_report(tmp_path, rollout_report(rollouts))
    again = write_report(tmp_path / "again", rollout_report(rollouts))
    assert [file.read_bytes() for file in again] == [file.read_bytes() for file in files]
    assert_page_is_sound(tmp_path / PAGE)


def test_a_stream_that_does_not_help_is_named_and_a_good_policy_goes_on() -> None:
    good = [rollout_episode(seed) for seed in range(200)]
    blind = [rollout_episode(seed, controller="features off") for seed in range(200)]
    advice = [
        block.words for block in rollout_report(rollouts_of(*good, *blind)).sections[-1].blocks
    ]
    assert len(advice) == 2 and "features off" in advice[0] and "vla-cache drive" in advice[1]


def test_figures_are_those_of_the_rollouts(rollouts: Rollouts) -> None:
    report = rollout_report(rollouts)
    (success,) = report.blocks(Table)
    policy = "60% (23% to 88%)"
    assert [row[:4] for row in success.rows] == [
        ("policy", policy, 5, pytest.approx(0.4)),
        ("demonstrator", "100% (57% to 100%)", 5, pytest.approx(0.4)),
        ("policy, features off", "0% (0% to 43%)", 5, 40.0),
    ]
    assert [row[5] for row in success.rows] == ["2 time is up", "", "5 time is up"]
    assert dict(report.tiles)["success of the policy"] == policy


def test_without_any_success_and_of_one_episode_of_one_tick() -> None:
    """As where the first observation stops it; then there is no median."""
    episodes = [failed(seed, lateral_mm=seed) for seed in range(4)]
    report = rollout_report(rollouts_of(*episodes))
    assert dict(report.tiles)["success of the policy"] == "0% (0% to 49%)"
    assert drawn(report) >= ALWAYS
    assert report.sections[2].parts[0].title.startswith("Worst: seed 3")
    assert drawn(rollout_report(rollouts_of(rollout_episode(7, ticks=1)))) == ALWAYS


def test_episodes_of_other_environments_have_no_needle() -> None:
    """Several tasks in one page, without figures; the longer of two failures is the worse."""
    plain: dict[str, Any] = {"trace": None, "reason": "the time is up", "success": False}
    made = [
        replace(rollout_episode(seed, level=task, **plain, time_s=seed), figures={})
        for task in ("hammer-v3", "assembly-v3")
        for seed in (1, 2, 3)
    ]
    made[0] = replace(made[0], success=True, reason="succeeded")
    report = rollout_report(rollouts_of(*made))
    names = [
        f"{task}_{kind}" for task in ("hammer-v3", "assembly-v3") for kind in ("worst", "median")
    ]
    assert drawn(report) == set(names)
    titles = [section.title for section in report.sections[1].parts]
    assert titles[0] == "Worst: seed 3, hammer-v3" and titles[1] == "Median: seed 2, hammer-v3"
    (table,) = report.blocks(Table)
    assert [row[3] for row in table.rows] == ["hammer-v3", "assembly-v3"]
