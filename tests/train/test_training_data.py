"""The ticks that a checkpoint lists on a side are found again, or refused by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import SplitParams
from pipeline.base.errors import CheckpointMismatch
from pipeline.base.provenance import SIDES, SplitPart
from pipeline.store import FeatureStore
from pipeline.train.split import split_by_episode
from pipeline.train.training_data import find_ticks, groups_of, split_parts

Parts = Mapping[str, SplitPart]


@dataclass(frozen=True)
class Listed:
    """What a checkpoint says of its episodes."""

    split: Mapping[str, Parts] = field(default_factory=dict[str, Parts])


def parts(**told: tuple[int, int, str]) -> Parts:
    """Of `left_000=(first, stop, content)` and the like."""
    return {
        name.replace("_", "/episode_", 1): SplitPart(
            ticks=(first, stop), content=content, group=f"group of {name}"
        )
        for name, (first, stop, content) in told.items()
    }


def find(store: FeatureStore, test: Parts) -> tuple[list[int], Any]:
    listed: Any = Listed({"train": {}, "val": {}, "test": test})
    ticks, named = find_ticks(store, listed, "test")
    return ticks.tolist(), named


@pytest.mark.parametrize("episodes", [1, 2, 6])
def test_the_split_is_found_again(tiny_store, tmp_path, episodes):
    store = FeatureStore.open(tiny_store(tmp_path, episodes=episodes))
    split = split_by_episode(store, SplitParams(), horizon=3)
    listed: Any = Listed(split_parts(store, split))
    for side in SIDES:
        ticks, again = find_ticks(store, listed, side)
        assert np.array_equal(ticks, getattr(split, side))
        assert again == listed
        names = [f"{e.source}/{e.id}" for e in np.array(store.episodes)[store.episode_of(ticks)]]
        assert groups_of(store, again, ticks).tolist() == [split.groups[name] for name in names]
    if episodes == 1:
        assert listed.split["test"]["left/episode_000"].ticks == (26, 30)
        assert listed.split["val"]["left/episode_000"].ticks == (20, 24)
        assert listed.split["train"]["left/episode_000"].ticks == (0, 18)


def test_episodes_that_are_gone_or_shorter_or_others_are_named(store):
    assert find(store, parts(right_001=(10, 30, "0-1")))[0] == list(range(40, 60))
    message = r"4 test episodes .* 3 are .*: left/episode_gone, left/episode_000, right/episode_003"
    wanted = parts(left_gone=(0, 3, "x"), left_000=(0, 31, "0-0"), right_001=(0, 30, "0-1"))
    wanted |= parts(right_003=(0, 30, "another recording of that name and length"))
    with pytest.raises(CheckpointMismatch, match=message):
        find(store, wanted)
    with pytest.raises(CheckpointMismatch, match=r"no test episode.*train_head\.split\.test 0"):
        find(store, {})


def test_renamed_episodes_are_told_by_their_content(store):
    """Also where two of them have taken each other's name; they keep their groups."""
    wanted = parts(left_old=(3, 9, "0-2"), left_000=(0, 7, "0-1"), right_001=(5, 6, "0-0"))
    ticks, named = find(store, wanted)
    assert ticks == [5, *range(30, 37), *range(63, 69)]
    told = {name: (part.ticks, part.group) for name, part in named.split["test"].items()}
    assert told == {
        "left/episode_002": ((3, 9), "group of left_old"),
        "right/episode_001": ((0, 7), "group of left_000"),
        "left/episode_000": ((5, 6), "group of right_001"),
    }
    groups = groups_of(store, named, np.array([5, 31, 63]))
    assert groups.tolist() == ["group of right_001", "group of left_000", "group of left_old"]
