"""A clock that goes backwards in a recording added later: the old store stays as it is."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.store.samples import content


@pytest.fixture
def backwards(recordings: Path, write_episode: Callable[..., Path]) -> Path:
    """The file of a new recording whose seventh stretch of readings comes before the sixth."""
    episode = write_episode(recordings / "Touch_dot" / "episode_4", 4)
    file = episode / "sensor_data.npz"
    with np.load(file) as loaded:
        arrays = dict(loaded)
    arrays["timestamps"][6] -= 0.35
    np.savez(file, **arrays)
    return file


def test_it_is_refused_or_skipped_and_changes_nothing(backwards, store, params, here):
    before = content(store)
    code, _, complained = here("stages.extract", params)
    assert code == 2
    assert "1 of 4 episodes cannot be used" in complained
    assert str(backwards) in complained
    assert "backwards" in complained
    assert "on_bad_episode=skip" in complained
    assert content(store) == before
    assert not store.with_name("made.zarr.part").exists()
    code, printed, complained = here("stages.extract", params, "--set", "data.on_bad_episode=skip")
    assert code == 0, complained
    assert str(backwards) in printed
    assert "up to date, nothing to do" in printed
    assert content(store) == before
    code, _, complained = here("stages.train_head", params, "--set", "train_head.max_steps=2")
    assert code == 0, complained
