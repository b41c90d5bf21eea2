"""Recordings to look at."""

from pathlib import Path

import pytest

from pipeline.simulation.insertion_formats import write_lerobot, write_raw
from pipeline.simulation.recorder import simulate_episode


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two simulated episodes as the recorder writes them, and one as LeRobot does."""
    root = tmp_path_factory.mktemp("machine")
    episodes = [simulate_episode(seed, 1.7e9 + 60 * seed) for seed in range(2)]
    for episode in episodes:
        write_raw(root / "raw", episode)
    write_lerobot(root / "lerobot", episodes[:1])
    return root
