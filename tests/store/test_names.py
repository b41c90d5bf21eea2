"""A row of a store is called by its episode, its number there and its time on that clock."""

import pytest

from pipeline.store import FeatureStore, episode_name, place


@pytest.fixture
def store(tiny_store, tmp_path) -> FeatureStore:
    return FeatureStore.open(tiny_store(tmp_path))


def test_an_episode_is_called_by_its_source_and_id(store):
    assert episode_name(store.episodes[1]) == "right/episode_001"


@pytest.mark.parametrize(
    ("stream", "row", "said"),
    [
        ("tick", 30, "right/episode_001, tick 0 (at 0.000 s)"),
        ("tick", 29, "left/episode_000, tick 29 (at 2.900 s)"),
        ("vl", 59, "right/episode_005, VL row 9 (at 2.700 s)"),
        ("sensor", 8, "left/episode_000, sensor reading 8 (at 0.100 s)"),
        ("state", 0, "left/episode_000, state reading 0 (at 0.000 s)"),
    ],
)
def test_a_row_is_placed_in_its_episode(store, stream, row, said):
    assert place(store, stream, row) == said
