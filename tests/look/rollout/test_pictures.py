"""The pictures of rollouts show their numbers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pipeline.evaluate.rollouts import RolloutEpisode, Rollouts
from pipeline.look.rollout import pictures as plots
from pipeline.simulation.insertion import FORCE_LIMIT_N, MISS_MM

MakeEpisode = Callable[..., RolloutEpisode]


def test_points_of_paths_are_coloured_by_success(rollouts: Rollouts) -> None:
    figure = plots.paths(rollouts)
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
    assert len(plots.paths(without).axes) == 2


def test_a_filmstrip_asks_for_frames_at_its_moments(make_episode: MakeEpisode) -> None:
    asked = list[float]()

    def frames(time_s: float) -> dict[str, np.ndarray]:
        asked.append(time_s)
        return {"View1": np.zeros((126, 224, 3), np.uint8)}

    episode = make_episode(ticks=60, frames=frames)
    figure = plots.filmstrip(episode, "Worst")
    assert len(asked) == 8
    assert (asked[0], asked[-1]) == (episode.trace.time_s[0], episode.trace.time_s[-1])
    assert [axis.get_title() for axis in figure.axes[:8]] == [f"{at:.1f} s" for at in asked]


def test_worst_and_median_stand_out_among_all(make_episode: MakeEpisode) -> None:
    episodes = [make_episode(seed) for seed in range(6)]
    figure = plots.courses(episodes, {"worst, seed 2": episodes[2], "median, seed 4": episodes[4]})
    assert len(figure.axes) == 4
    for axis in figure.axes:
        strong = [line for line in axis.lines if line.get_linewidth() == 2.4]
        assert [line.get_label() for line in strong] == ["worst, seed 2", "median, seed 4"]
        assert len(axis.lines) == 6 + 2 + 1
    force = figure.axes[-1]
    assert force.lines[0].get_ydata().max() == 0.6
    assert force.lines[-1].get_ydata()[0] == FORCE_LIMIT_N
