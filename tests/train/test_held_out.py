"""The ticks a checkpoint says it has not seen are found again, or refused by name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import CheckpointMismatch
from pipeline.store import FeatureStore
from pipeline.train.split import (
    held_out_contents,
    held_out_ranges,
    held_out_ticks,
    named_as_in,
    split_by_episode,
)


@pytest.mark.parametrize("episodes", [1, 2, 6])
def test_the_split_is_found_again(
    tiny_store: Callable[..., Path], tmp_path: Path, episodes: int
) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=episodes))
    split = split_by_episode(store, 0.3)
    ranges = held_out_ranges(store, split.held_out)
    assert tuple(sorted(ranges)) == split.held_out_episodes
    contents = held_out_contents(store, ranges)
    assert np.array_equal(held_out_ticks(store, ranges, contents), split.held_out)
    if episodes == 1:
        assert ranges == {"left/episode_000": (24, 30)}


def test_episodes_that_are_gone_or_shorter_are_named(store: FeatureStore) -> None:
    contents = {"right/episode_001": "0-1", "left/episode_000": "0-0", "left/gone": "x"}
    found = held_out_ticks(store, {"right/episode_001": (10, 30)}, contents)
    assert found.tolist() == list(range(40, 60))
    said = r"of the 3 episodes .* 2 are not .*left/gone is missing; left/episode_000 is shorter"
    with pytest.raises(CheckpointMismatch, match=said):
        held_out_ticks(
            store,
            {"left/gone": (0, 3), "left/episode_000": (0, 31), "right/episode_001": (0, 30)},
            contents,
        )
    with pytest.raises(CheckpointMismatch, match="val_fraction 0"):
        held_out_ticks(store, {}, {})


def test_other_recordings_of_the_same_names_and_lengths_are_refused(store: FeatureStore) -> None:
    ranges = {"left/episode_000": (0, 30), "right/episode_001": (0, 30)}
    contents = {"left/episode_000": "0-0", "right/episode_001": "another recording"}
    said = r"of the 2 episodes .* 1 are not .*: right/episode_001 is another recording"
    with pytest.raises(CheckpointMismatch, match=said):
        held_out_ticks(store, ranges, contents)


@dataclass(frozen=True)
class HeldOut:
    """What a checkpoint says of the episodes that it holds out."""

    held_out_ticks: dict[str, tuple[int, int]]
    held_out_content: dict[str, str]


def test_an_episode_that_is_gone_is_not_hidden_by_one_under_its_name(store: FeatureStore) -> None:
    contents = {"left/episode_000": "removed since", "left/episode_009": "0-0"}
    checkpoint: Any = HeldOut({"left/episode_000": (0, 7), "left/episode_009": (0, 9)}, contents)
    assert named_as_in(store, checkpoint) == (checkpoint, None)
    with pytest.raises(CheckpointMismatch, match=r"of the 2 episodes .* 2 are not"):
        held_out_ticks(store, checkpoint.held_out_ticks, contents)
