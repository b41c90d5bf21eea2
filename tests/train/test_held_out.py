"""The ticks a checkpoint says it has not seen are found again, or refused by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.errors import CheckpointMismatch
from pipeline.store import FeatureStore
from pipeline.train.split import (
    find_held_out,
    held_out_contents,
    held_out_ranges,
    split_by_episode,
)


@dataclass(frozen=True)
class HeldOut:
    """What a checkpoint says of the episodes that it holds out."""

    held_out_ticks: Mapping[str, tuple[int, int]]
    held_out_content: Mapping[str, str]


def find(
    store: FeatureStore, ranges: Mapping[str, tuple[int, int]], contents: Mapping[str, str]
) -> tuple[list[int], HeldOut]:
    held_out: Any = HeldOut(ranges, contents)
    ticks, named = find_held_out(store, held_out)
    return ticks.tolist(), HeldOut(named.held_out_ticks, named.held_out_content)


@pytest.mark.parametrize("episodes", [1, 2, 6])
def test_the_split_is_found_again(
    tiny_store: Callable[..., Path], tmp_path: Path, episodes: int
) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, episodes=episodes))
    split = split_by_episode(store, 0.3)
    ranges = held_out_ranges(store, split.held_out)
    assert tuple(sorted(ranges)) == split.held_out_episodes
    contents = held_out_contents(store, ranges)
    assert find(store, ranges, contents) == (split.held_out.tolist(), HeldOut(ranges, contents))
    if episodes == 1:
        assert ranges == {"left/episode_000": (24, 30)}


def test_episodes_that_are_gone_or_shorter_are_named(store: FeatureStore) -> None:
    contents = {"right/episode_001": "0-1", "left/episode_000": "0-0", "left/gone": "x"}
    assert find(store, {"right/episode_001": (10, 30)}, contents)[0] == list(range(40, 60))
    message = r"of the 3 episodes .* 2 are not .*left/gone is missing; left/episode_000 is shorter"
    wanted = {"left/gone": (0, 3), "left/episode_000": (0, 31), "right/episode_001": (0, 30)}
    with pytest.raises(CheckpointMismatch, match=message):
        find(store, wanted, contents)
    with pytest.raises(CheckpointMismatch, match="val_fraction 0"):
        find(store, {}, {})


def test_other_recordings_of_the_same_names_and_lengths_are_refused(store: FeatureStore) -> None:
    ranges = {"left/episode_000": (0, 30), "right/episode_001": (0, 30)}
    contents = {"left/episode_000": "0-0", "right/episode_001": "another recording"}
    message = r"of the 2 episodes .* 1 are not .*: right/episode_001 is another recording"
    with pytest.raises(CheckpointMismatch, match=message):
        find(store, ranges, contents)


def test_renamed_episodes_are_told_by_their_content(store: FeatureStore) -> None:
    """Also where two of them have taken each other's name."""
    ranges = {"left/old": (3, 9), "left/episode_000": (0, 7), "right/episode_001": (5, 6)}
    contents = {"left/old": "0-2", "left/episode_000": "0-1", "right/episode_001": "0-0"}
    ticks, named = find(store, ranges, contents)
    assert ticks == [5, *range(30, 37), *range(63, 69)]
    assert named.held_out_ticks == {
        "left/episode_002": (3, 9),
        "right/episode_001": (0, 7),
        "left/episode_000": (5, 6),
    }


def test_an_episode_that_is_gone_is_not_hidden_by_one_under_its_name(store: FeatureStore) -> None:
    contents = {"left/episode_000": "removed since", "left/episode_009": "0-0"}
    with pytest.raises(CheckpointMismatch, match=r"of the 2 episodes .* 1 are not"):
        find(store, {"left/episode_000": (0, 7), "left/episode_009": (0, 9)}, contents)
