"""Three sides: whole groups, drawn by hash, or cut by time where there are too few of them."""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pipeline.base.config import SplitParams
from pipeline.base.errors import ConfigError, StoreMismatch
from pipeline.base.provenance import SIDES
from pipeline.train.sampling import ticks_by_source
from pipeline.train.split import Split, episodes_by_group, hash64, split_by_episode


@dataclass
class FakeEpisode:
    id: str
    source: str
    ticks: range
    vl_rows: range
    content: str
    group: str | None = None


class FakeStore:
    """Episodes of these lengths and first VL keys, as the split sees them.

    Their ticks are 0.1 s apart, the first `late` s after the frame it sees; clocks differ.
    """

    path = Path("fake.zarr")

    def __init__(
        self,
        lengths: Sequence[int],
        keys: Sequence[int] | None = None,
        sources: str = "s",
        late: list[float] | None = None,
        cameras: bool = True,
    ):
        tick = np.cumsum([0, *lengths])
        row = np.cumsum([0, *(-(-n // 3) for n in lengths)])
        self.episodes = tuple(
            FakeEpisode(
                f"episode_{i}",
                sources[i % len(sources)],
                range(tick[i], tick[i + 1]),
                range(row[i], row[i + 1]),
                f"content {i}",
            )
            for i in range(len(lengths))
        )
        self.sources = list(sources)
        self._keys = np.arange(row[-1] * 16).reshape(-1, 16).astype(np.int64)
        for episode, key in zip(self.episodes, keys or [], strict=False):
            self._keys[episode.vl_rows] = -key
        self._time = np.empty(tick[-1])
        self._frames = np.full((row[-1], 2), np.nan)
        self.action = np.random.default_rng(0).normal(size=(tick[-1], 3)).astype(np.float32)
        for i, episode in enumerate(self.episodes):
            start = 1.7e9 * (i % 2) + 0.05
            self._time[episode.ticks] = start + np.arange(len(episode.ticks)) * 0.1
            if cameras and len(episode.vl_rows):
                taken = start - (late[i] if late else 0.0)
                self._frames[episode.vl_rows.start] = taken - 0.03, taken

    def array(self, name: str) -> np.ndarray:
        return {
            "vl/key": self._keys,
            "tick/time": self._time,
            "tick/action": self.action,
            "vl/frame_time": self._frames,
        }[name]

    def names(self, ticks: np.ndarray) -> set[str]:
        return {
            f"{e.source}/{e.id}" for e in self.episodes if np.isin(np.array(e.ticks), ticks).any()
        }


def drawn(store: Any, horizon: int = 8, **params: Any) -> Split:
    return split_by_episode(store, SplitParams(**params), horizon)


def sides_of(store: Any, split: Split) -> dict[str, str]:
    """The side of each episode; no episode is on two."""
    sides: dict[str, str] = {}
    for side in SIDES:
        names = store.names(getattr(split, side))
        assert not sides.keys() & names
        sides |= dict.fromkeys(names, side)
    return sides


def names(numbers: Collection[int], source: str = "s") -> set[str]:
    return {f"{source}/episode_{i}" for i in numbers}


class TestGroups:
    def groups(self, store: Any, **named: Any) -> list[set[str]]:
        groups = episodes_by_group(store, named)
        members = [{f"{e.source}/{e.id}" for e in group} for group in groups.values()]
        assert [min(own) for own in members] == list(groups)
        return members

    def test_equal_keys_without_a_frame_are_not_one_recording(self):
        assert len(self.groups(FakeStore([30] * 8, keys=[7] * 8, cameras=False))) == 8
        assert len(self.groups(FakeStore([30] * 8, keys=[7] * 8))) == 1

    @given(
        st.integers(2, 60),
        st.sampled_from([0.02, 1.0, 800.0]),
        st.floats(-600, 600),
        st.sampled_from([np.float16, np.float32, "3 decimals", "6 digits"]),
        st.integers(0, 2**32 - 1),
    )
    @settings(deadline=None)
    def test_a_copy_that_was_encoded_again_is_of_its_group(
        self, length, scale, offset, encoding, seed
    ):
        """Whichever way its numbers are rounded; a channel rests but for that."""
        store, rng = FakeStore([length] * 3), np.random.default_rng(seed)
        action = rng.normal(size=(length, 3)) * scale * [1, 0.3, 0] + offset
        if encoding is np.float16:
            action -= offset  # it has three digits in all
        if encoding == "3 decimals":
            action *= 1 / scale
            copy = np.round(action, 3)
        elif encoding == "6 digits":
            copy = np.vectorize(lambda x: float(f"{x:.6g}"))(action)
        else:
            copy = action.astype(encoding)
        store.action[:length], store.action[2 * length :] = action, copy
        spread = np.ptp(action, axis=0).max()
        if np.abs(copy - action).max() < 0.5e-4 * spread:
            assert self.groups(store) == [names([0, 2]), names([1])]

    def test_other_actions_are_of_another_group(self):
        store = FakeStore([40, 40])
        store.action[40:] = store.action[:40]
        change = 0.01 * np.ptp(store.action[:40, 1])
        store.action[58:60, 1] += [change, -change]  # first, mean and last action stay
        assert len(self.groups(store)) == 2

    def test_actions_that_never_change_tell_nothing(self):
        store = FakeStore([5, 5, 1, 1])
        store.action[:] = 3.0
        assert len(self.groups(store)) == 4

    def test_recordings_and_params_put_episodes_together(self):
        store = FakeStore([5] * 8)
        store.episodes[1].group = store.episodes[6].group = "monday"
        store.episodes[2].group = "tuesday"
        store.episodes[3].content = store.episodes[4].content
        told = self.groups(store, here=("s/*_6", "s/episode_0"), there=("s/episode_2",))
        assert told == [names([0, 1, 6]), names([2]), names([3, 4]), names([5]), names([7])]
        with pytest.raises(ConfigError, match=r"split\.groups\.here.*'s/seven' fits none of 8"):
            self.groups(store, here=("s/episode_1", "s/seven"))

    def test_what_shares_a_group_is_one(self):
        """By key the first and the second, by action the second and the third."""
        store = FakeStore([9, 9, 9, 9], keys=[1, 1, 2, 3])
        store.action[18:27] = store.action[9:18]
        assert self.groups(store) == [names([0, 1, 2]), names([3])]


shares = st.tuples(st.floats(0, 0.6), st.floats(0, 0.35))


class TestSides:
    @given(
        st.lists(st.integers(1, 20), min_size=3, max_size=30),
        shares,
        st.integers(0, 99),
        st.integers(1, 3),
        st.booleans(),
    )
    @settings(deadline=None)
    def test_whole_groups_fall_on_one_side_each(self, lengths, shares, seed, sources, paired):
        """And each source of three or more has one on each side asked for, one of two trains."""
        keys = [i // 2 for i in range(len(lengths))] if paired else None
        store = FakeStore(lengths, keys, sources="abc"[:sources])
        val, test = shares
        if paired and len(lengths) < 5:
            return  # fewer than three groups, which may be refused as too short to cut
        split = drawn(store, 1, val=val, test=test, seed=seed)
        sides, asked = sides_of(store, split), {"train"}
        asked |= {side for side, share in (("val", val), ("test", test)) if share}
        assert set(sides.values()) == asked
        side_of_group = {(split.groups[name], side) for name, side in sides.items()}
        assert len(side_of_group) == len(set(split.groups.values())), "no group is on two sides"
        assert sides.keys() == split.groups.keys()
        if paired:
            return
        for source in store.sources:
            own = {side for name, side in sides.items() if name.startswith(source)}
            count = sum(name.startswith(source) for name in sides)
            assert own == asked if count > 2 else count < 2 or "train" in own

    def test_the_hash_of_seed_and_name_decides(self):
        store = FakeStore([3] * 1000)
        for seed in (0, 7):
            split = drawn(store, val=0.1, test=0.2, seed=seed)
            for name, side in sides_of(store, split).items():
                rank = hash64(f"{seed} {name}") / 2**64
                assert side == ("test" if rank < 0.2 else "val" if rank < 0.3 else "train")
            assert split.note is None
            assert 150 < len(split.test) / 3 < 250
            assert 75 < len(split.val) / 3 < 125

    def test_what_was_moved_is_noted(self):
        split = drawn(FakeStore([6] * 4, sources="ab"), val=0.01, test=0.01)
        assert split.note is not None
        assert "test had nothing of all sources, " in split.note
        assert "val had nothing of all sources, " in split.note
        split = drawn(FakeStore([6] * 3), val=0.01, test=0.01)
        assert "test had nothing of source 's', " in str(split.note)

    @pytest.mark.parametrize("train", [5, 10_000])
    def test_fewer_are_trained_on_and_no_other_side_changes(self, train):
        store = FakeStore([10] * 40)
        whole, part = drawn(store), drawn(store, train=train)
        assert part.test.tolist() == whole.test.tolist()
        assert part.val.tolist() == whole.val.tolist()
        sides, before = sides_of(store, part), sides_of(store, whole)
        kept = {name for name, side in sides.items() if side == "train"}
        all_of_them = {name for name, side in before.items() if side == "train"}
        assert kept <= all_of_them and len(kept) == min(train, len(all_of_them))
        more = sides_of(store, drawn(store, train=train + 1))
        assert kept <= {name for name, side in more.items() if side == "train"}

    def test_nothing_is_held_out_at_zero(self):
        for lengths in ([6], [6, 6], [6] * 5):
            split = drawn(FakeStore(lengths), val=0, test=0)
            assert len(split.train) == sum(lengths)
            assert not len(split.val) + len(split.test)
            assert split.note is None

    @pytest.mark.parametrize("asked", ["val", "test"])
    def test_of_two_one_is_held_out_and_one_trained_on(self, asked):
        for share in (1e-9, 0.99):
            split = drawn(FakeStore([6, 6]), **({"val": 0, "test": 0} | {asked: share}))
            assert len(getattr(split, asked)) == len(split.train) == 6

    @pytest.mark.parametrize(
        ("params", "said"),
        [
            ({"val": 0.5, "test": 0.5}, "leave nothing to train on"),
            ({"val": 0.5, "folds": 2}, "leave nothing to train on"),
            ({"folds": 5, "fold": 5}, "fold 5 of folds 5"),
            ({"fold": 1}, "fold 1 of folds None"),
        ],
    )
    def test_what_cannot_be_is_refused(self, params, said):
        with pytest.raises(ValidationError, match=said):
            SplitParams(**params)


class TestFolds:
    @given(st.integers(2, 6), st.integers(0, 20), st.integers(1, 3), st.integers(0, 9))
    @settings(deadline=None, max_examples=40)
    def test_every_group_is_test_in_one_fold(self, folds, more, sources, seed):
        """Folds are balanced within each source, and every one trains and has a val."""
        store = FakeStore([6] * (folds + more), sources="abc"[:sources])
        seen = Counter[str]()
        for fold in range(folds):
            split = drawn(store, 1, val=0.2, folds=folds, fold=fold, seed=seed)
            test = store.names(split.test)
            seen.update(test)
            assert len(split.train)
            assert len(split.val)
            assert not test & (store.names(split.train) | store.names(split.val))
            for source in store.sources:
                whole = sum(episode.source == source for episode in store.episodes)
                own = sum(name.startswith(source) for name in test)
                assert whole // folds <= own <= -(-whole // folds)
        assert seen == Counter(store.names(np.arange(6 * (folds + more))))

    def test_more_folds_than_groups_are_refused(self):
        with pytest.raises(ConfigError, match=r"folds is 5, but the store has 4 group"):
            drawn(FakeStore([6] * 4), folds=5)

    def test_val_is_not_the_same_in_every_fold(self):
        store = FakeStore([6] * 10)
        val = [store.names(drawn(store, folds=5, fold=fold).val) for fold in range(5)]
        assert len(set().union(*val)) > 2


class TestCutByTime:
    def test_of_two_groups_one_is_test_and_val_is_the_tail_of_the_other(self):
        store = FakeStore([100, 100])
        split = drawn(store, 8)
        (held,), (trained,) = store.names(split.test), store.names(split.train)
        assert {held, trained} == names([0, 1])
        assert len(split.test) == 100
        first = 100 * (trained == "s/episode_1")
        assert split.val.tolist() == list(range(first + 85, first + 100))
        # The chunk of the last trained tick, 77, ends at 84.
        assert split.train.tolist() == list(range(first, first + 78))
        assert "of 2 groups 1 is test" in str(split.note)

    def test_a_single_episode_is_cut_into_three_behind_gaps(self):
        split = drawn(FakeStore([100]), 8, val=0.1, test=0.2)
        assert split.test.tolist() == list(range(80, 100))
        assert split.val.tolist() == list(range(63, 73))
        assert split.train.tolist() == list(range(56))
        assert "20% of its ticks, cut from its end, are test" in str(split.note)
        assert "less than a recording never seen" in str(split.note)

    def test_formats_of_one_recording_are_cut_at_one_instant(self):
        """The second begins 1 s later and ends 3 s earlier: its tail would begin at 5.8 s."""
        store = FakeStore([100, 60], keys=[7, 7], late=[0.0, 1.0])
        split = drawn(store, 4, val=0, test=0.2)
        assert split.test.tolist() == [*range(58, 100), *range(148, 160)]
        assert split.train.tolist() == [*range(55), *range(100, 145)]

    def test_an_action_that_lasts_beyond_the_cut_is_not_trained_on(self):
        """Ticks of the second lie between those of the first; the cut is at 8 s."""
        store = FakeStore([100, 100], keys=[7, 7], late=[0.0, 0.05])
        split = drawn(store, 1, val=0, test=0.2)
        assert split.test.tolist() == [*range(80, 100), *range(180, 200)]
        # Of the second, the action of tick 79 lasts from 7.95 s to 8.05 s.
        assert split.train.tolist() == [*range(80), *range(100, 179)]

    @given(
        st.lists(st.tuples(st.integers(1, 90), st.floats(0, 3)), min_size=1, max_size=4),
        st.integers(1, 12),
        st.tuples(st.sampled_from([0.0, 0.1, 0.3]), st.sampled_from([0.0, 0.2, 0.4])),
    )
    # Of one tick, whose action lasts beyond the cut.
    @example([(1, 1.25), (16, 0.0)], 1, (0.0, 0.2))
    @example([(1, 1.25), (16, 0.0)], 1, (0.2, 0.2))
    @settings(deadline=None)
    def test_no_chunk_reaches_into_the_next_side(self, formats, horizon, shares):
        lengths, late = [list(column) for column in zip(*formats, strict=True)]
        store = FakeStore(lengths, [7] * len(formats), late=late)
        try:
            split = drawn(store, horizon, val=shares[0], test=shares[1])
        except ConfigError:
            return
        begins: dict[str, list[float]] = {side: [] for side in SIDES}
        ends: dict[str, list[float]] = {side: [] for side in SIDES}
        for episode, waited in zip(store.episodes, late, strict=True):
            for tick in episode.ticks:
                for side in SIDES:
                    if tick in getattr(split, side):
                        last = min(tick + horizon, episode.ticks.stop)
                        begins[side].append(waited + 0.1 * (tick - episode.ticks.start))
                        ends[side].append(waited + 0.1 * (last - episode.ticks.start))
        assert ends["train"]
        for before, after in (("train", "val"), ("train", "test"), ("val", "test")):
            if ends[before] and begins[after]:
                assert max(ends[before]) <= min(begins[after]) + 1e-5

    def test_too_short_to_hold_ticks_out_trains_on_all(self):
        split = drawn(FakeStore([2]))
        assert len(split.train) == 2
        assert not len(split.val) + len(split.test)
        assert "too short" in str(split.note)

    def test_a_format_that_ends_before_the_cut_is_trained_on_whole(self):
        store = FakeStore([100, 2], keys=[7, 7], late=[0.0, 0.0])
        split = drawn(store, 8, val=0, test=0.2)
        assert split.train.tolist() == [*range(73), 100, 101]
        assert store.names(split.test) == {"s/episode_0"}

    def test_the_longest_horizon_that_leaves_a_tick(self):
        assert drawn(FakeStore([10]), 8, val=0, test=0.2).train.tolist() == [0]
        assert drawn(FakeStore([19]), 8, val=0.1, test=0.1).train.tolist() == [0]

    def test_a_horizon_that_leaves_nothing_is_refused(self):
        with pytest.raises(ConfigError, match=r"of 18 ticks.*train_head\.horizon 8 "):
            drawn(FakeStore([18]), 8)

    def test_episodes_without_ticks_are_no_recordings(self):
        split = drawn(FakeStore([0, 100, 0]))
        assert "a single group (s/episode_1)" in str(split.note)
        with pytest.raises(StoreMismatch, match="found none"):
            drawn(FakeStore([0, 0]))


def test_ticks_are_told_by_source():
    store: Any = FakeStore([3, 0, 2, 4], sources="abc")
    told = ticks_by_source(store, np.array([0, 3, 5, 8, 2]))
    expected = {"a": [0, 5, 8, 2], "b": [], "c": [3]}
    assert {name: ticks.tolist() for name, ticks in told.items()} == expected
