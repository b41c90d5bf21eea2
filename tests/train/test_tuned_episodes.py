"""Episodes that a store's model was tuned or chosen on do not judge policies on top of it."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import SplitParams
from pipeline.base.errors import CheckpointIncomplete, ConfigError
from pipeline.base.provenance import (
    SIDES,
    TUNED_ON,
    TunedOn,
    TunedPart,
    join_tuned_on,
    read_tuned_on,
    tuned_on_attributes,
    tuned_on_of_store,
    write_tuned_on,
)
from pipeline.store import FeatureStore
from pipeline.train.split import Split, split_by_episode
from pipeline.train.training_data import refuse_tuned_episodes


def part(number: int, ticks: tuple[int, int] = (0, 30), content: str | None = None) -> TunedPart:
    name = f"{('left', 'right')[number % 2]}/episode_{number:03d}"
    return TunedPart(episode=name, ticks=ticks, content=content or f"0-{number}", group=name)


@pytest.fixture
def tuned_store(store_saying, tmp_path):
    """`tuned_store(tuned, episodes=6)`: a store whose adapter says that, or nothing for None."""

    def make(tuned: TunedOn | None, episodes: int = 6) -> FeatureStore:
        entries = {"feature_spec": {"adapter": "a digest"}, **tuned_on_attributes(tuned)}
        return store_saying(tmp_path, entries, episodes=episodes)

    return make


def whole(store: FeatureStore, **sides: list[int]) -> Split:
    """These episodes of 30 ticks on each side."""
    ticks = np.arange(store.ticks).reshape(-1, 30)
    arrays = {side: ticks[sides.get(side, [])].reshape(-1) for side in SIDES}
    names = [f"{e.source}/{e.id}" for e in store.episodes]
    return Split(**arrays, groups=dict(zip(names, names, strict=True)), note=None)


def test_what_it_was_tuned_or_chosen_on_is_refused(tuned_store):
    store = tuned_store(TunedOn(train=(part(0), part(1)), val=(part(2),)))
    assert refuse_tuned_episodes(store, whole(store, train=[0, 1], val=[2, 3], test=[4, 5])) == []
    with pytest.raises(ConfigError, match=r"\(test: left/episode_002\).* same seed above all"):
        refuse_tuned_episodes(store, whole(store, train=[0], val=[3], test=[2, 4]))
    with pytest.raises(ConfigError, match=r"\(test: right/episode_001; val: left/episode_000\)"):
        refuse_tuned_episodes(store, whole(store, train=[2], val=[0, 3], test=[1]))


def test_episodes_are_known_by_content_and_a_group_is_known_whole(tuned_store):
    store = tuned_store(TunedOn(train=(part(9, content="0-3"), part(0, content="elsewhere"))))
    split = whole(store, train=[1], val=[2], test=[0, 3, 5])
    split.groups["right/episode_005"] = "right/episode_003"  # type: ignore[index]
    with pytest.raises(ConfigError, match=r"\(test: right/episode_003, right/episode_005\)"):
        refuse_tuned_episodes(store, split)


def test_a_recording_cut_by_time_may_be_on_all_sides(tuned_store):
    store = tuned_store(TunedOn(train=(part(0, (0, 20)),), val=(part(0, (20, 26)),)), episodes=1)
    split = split_by_episode(store, SplitParams(), horizon=3)
    assert refuse_tuned_episodes(store, split) == []
    earlier = split_by_episode(store, SplitParams(test=0.3), horizon=3)
    with pytest.raises(ConfigError, match=r"\(test: left/episode_000; val: left/episode_000\)"):
        refuse_tuned_episodes(store, earlier)


def test_an_adapter_that_says_nothing_is_told_of(tuned_store, store):
    silent = tuned_store(None)
    (line,) = refuse_tuned_episodes(silent, whole(silent, train=[0], test=[1]))
    assert "does not say what it was tuned on" in line
    assert refuse_tuned_episodes(store, whole(store, train=[0], test=[1])) == []


def test_it_comes_back_and_damage_is_named(tmp_path):
    assert read_tuned_on(tmp_path) is None
    tuned = TunedOn(train=(part(0), part(1, (3, 9))), val=(part(2),))
    write_tuned_on(tmp_path, tuned)
    assert read_tuned_on(tmp_path) == tuned
    assert tuned_on_of_store(tuned_on_attributes(tuned), Path("a.zarr")) == tuned
    assert tuned_on_attributes(tuned_on_of_store({}, Path("a.zarr"))) == {}
    again = join_tuned_on([None, tuned, TunedOn(train=(part(1, (3, 9)), part(4)))])
    assert again == TunedOn(train=(part(0), part(1, (3, 9)), part(4)), val=(part(2),))
    (tmp_path / TUNED_ON).write_text('{"train": [{"episode": "a/b"}]}')
    with pytest.raises(CheckpointIncomplete, match=TUNED_ON):
        read_tuned_on(tmp_path)
