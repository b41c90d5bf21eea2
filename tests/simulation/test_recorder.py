"""A demonstration: disturbed, and a success all the same."""

import numpy as np
import pytest

from pipeline.simulation.insertion import INSERTED, NeedleInsertion
from pipeline.simulation.insertion_layout import draw_layout
from pipeline.simulation.recorder import simulate_episode
from pipeline.simulation.rendering import photograph


@pytest.mark.parametrize("seed", range(2))
def test_it_succeeds_and_is_disturbed(seed: int) -> None:
    episode = simulate_episode(seed, 0.0)
    assert episode.insertion.outcome == INSERTED
    layout = draw_layout(episode.insertion.layout.seed, "moved")
    calm = NeedleInsertion()
    calm.start(episode.insertion.layout)
    # The arm is where noise in every tick has led it, not where the demonstrator alone would be.
    for _ in range(8):
        calm.step(calm.expert_action())
    apart = calm.knots[8].pose[:3] - episode.insertion.knots[8].pose[:3]
    assert 0.005 < np.linalg.norm(apart) < 0.5
    assert len(episode.insertion.layout.push_times_s) == len(layout.push_times_s) + 4


def test_nudges_move_the_target_a_little_and_pushes_as_far_as_ever() -> None:
    lengths = []
    for seed in range(8):
        nudged = simulate_episode(seed, 0.0).insertion.layout
        pushes = draw_layout(nudged.seed, "moved").push_times_s
        steps = np.linalg.norm(np.diff(nudged.targets_mm, axis=0), axis=1)
        is_push = np.isin(nudged.push_times_s, pushes)
        assert is_push.sum() == len(pushes) and (steps[~is_push] <= 1.2 + 1e-9).all()
        lengths += steps[~is_push].tolist()
    assert np.median(lengths) > 0.4


def test_a_camera_may_begin_a_moment_before_the_episode() -> None:
    insertion = simulate_episode(3, 0.0).insertion
    assert photograph("View1", insertion, -0.0004).shape == (126, 224, 3)
