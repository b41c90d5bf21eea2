"""A small demo, written once for all tests of the formats."""

from pathlib import Path

import pytest

from pipeline.simulation.demo_recordings import write_demo_recordings

EPISODES, SEED = 3, 7


@pytest.fixture(scope="session")
def demo_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes a format: enough for each variant of the `new` format."""
    root = tmp_path_factory.mktemp("demo") / "recordings"
    write_demo_recordings(root, EPISODES, SEED)
    return root
