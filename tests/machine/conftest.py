"""Recordings to look at."""

from pathlib import Path

import pytest

from pipeline.simulation.demo_recordings import write_demo_recordings


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two simulated episodes in each format."""
    root = tmp_path_factory.mktemp("machine") / "demo"
    write_demo_recordings(root, 2, 0)
    return root
