from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.base.errors import ConfigError, StoreMismatch
from pipeline.store import FeatureStore
from pipeline.train.sampling import TickSampler, ticks_by_source
from pipeline.train.split import hash64, split_by_episode


@dataclass
class FakeEpisode:
    id: str
    source: str
    ticks: range
    vl_rows: range


class FakeStore:
    """Episodes of these lengths and first VL keys, as the split sees them.

    Their ticks are 0.1 s apart, the first `late` s after the frame it sees; clocks differ.
    """

    path = Path("fake.zarr")

    def __init__(
        self,
        lengths: list[int],
        keys: list[int] | None = None,
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
            )
            for i in range(len(lengths))
        )
        self.sources = list(sources)
        self._keys = np.arange(row[-1] * 16).reshape(-1, 16).astype(np.int64)
        for episode, key in zip(self.episodes, keys or [], strict=False):
            self._keys[episode.vl_rows] = -key
        self._time = np.empty(tick[-1])
        self._frames = np.full((row[-1], 2), np.nan)
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
            "vl/frame_time": self._frames,
        }[name]

    def names(self, ticks: np.ndarray) -> set[str]:
        return {
            f"{e.source}/{e.id}" for e in self.episodes if np.isin(np.array(e.ticks), ticks).any()
        }


class TestSplit:
    def test_equal_keys_without_a_frame_are_not_one_recording(self):
        store = FakeStore([30] * 8, keys=[7] * 8, cameras=False)
        split = split_by_episode(store, 0.3)
        assert split.note is None or "single recording" not in split.note
        assert len(split.held_out_episodes) in range(1, 8)
        assert set(split.held_out_episodes) == store.names(split.held_out)

    @given(
        st.lists(st.integers(1, 20), min_size=2, max_size=30), st.floats(0.01, 1.0), st.booleans()
    )
    @settings(deadline=None)
    def test_whole_episodes_fall_on_one_side_each(
        self, lengths: list[int], fraction: float, paired: bool
    ) -> None:
        keys = [i // 2 for i in range(len(lengths))] if paired else None
        store = FakeStore(lengths, keys)
        split = split_by_episode(store, fraction, horizon=1)
        if paired and len(lengths) == 2:
            assert split.note is not None
            return
        both = np.concatenate([split.train, split.held_out])
        assert np.array_equal(np.sort(both), np.arange(sum(lengths)))
        assert store.names(split.held_out) == set(split.held_out_episodes)
        assert not store.names(split.train) & store.names(split.held_out)
        assert len(split.train)
        assert len(split.held_out)

    def test_the_same_recording_in_two_formats_shares_a_side(self) -> None:
        keys = [*range(20), *range(20)]
        for fraction in (0.1, 0.5, 0.9):
            store = FakeStore([6] * 40, keys)
            held_out = set(split_by_episode(store, fraction).held_out_episodes)
            for i in range(20):
                assert (f"s/episode_{i}" in held_out) == (f"s/episode_{i + 20}" in held_out)

    def test_a_new_episode_moves_no_other(self) -> None:
        before = split_by_episode(FakeStore([6] * 40), 0.3).held_out_episodes
        after = split_by_episode(FakeStore([6] * 41), 0.3).held_out_episodes
        assert set(after) - {"s/episode_40"} == set(before)

    def test_another_format_of_an_episode_moves_no_other(self) -> None:
        before = split_by_episode(FakeStore([6] * 40), 0.3).held_out_episodes
        for twin in range(40):
            store = FakeStore([6] * 41, [*range(40), twin], sources="s")
            # Its name comes first, so that the pair's side is by its hash.
            store.episodes[40].id = "another_format"
            after = split_by_episode(store, 0.3).held_out_episodes
            pair = {f"s/episode_{twin}", "s/another_format"}
            assert set(after) - pair == set(before) - pair
            assert len(pair & set(after)) in (0, 2)

    def test_the_fraction_is_about_kept(self) -> None:
        held_out = split_by_episode(FakeStore([3] * 2000), 0.1).held_out_episodes
        assert 150 < len(held_out) < 250

    @given(st.integers(2, 30), st.integers(1, 4), st.floats(0.01, 0.99))
    @settings(deadline=None)
    def test_a_source_of_two_recordings_keeps_one_to_train_on(
        self, episodes: int, sources: int, fraction: float
    ) -> None:
        """And where all have one by the hash of names, nothing else decides."""
        store = FakeStore([6] * episodes, sources="abcd"[:sources])
        split = split_by_episode(store, fraction)
        names = {source: set[str]() for source in store.sources}
        for episode in store.episodes:
            names[episode.source].add(f"{episode.source}/{episode.id}")
        trained = store.names(split.train)
        assert all(trained & own for own in names.values() if len(own) > 1)

        drawn = {n for own in names.values() for n in own if hash64(n) / 2**64 < fraction}
        if drawn and all(own - drawn for own in names.values()):
            assert set(split.held_out_episodes) == drawn
            assert split.note is None

    def test_what_a_source_keeps_to_train_on_is_said(self) -> None:
        """At 0.6 both recordings of a are drawn, by 0.37 and 0.60; b has one on either side."""
        split = split_by_episode(FakeStore([6] * 4, sources="ab"), 0.6)
        assert split.held_out_episodes == ("a/episode_0", "b/episode_3")
        assert split.note is not None
        assert "source 'a'" in split.note

    @pytest.mark.parametrize("fraction", [1e-9, 1.0])
    def test_of_two_one_is_held_out_and_one_trained_on(self, fraction: float) -> None:
        split = split_by_episode(FakeStore([6, 6]), fraction)
        assert len(split.held_out) == len(split.train) == 6
        assert "of 2 recordings" in str(split.note)

    def test_nothing_is_held_out_at_zero(self) -> None:
        split = split_by_episode(FakeStore([6]), 0.0)
        assert len(split.train) == 6
        assert not len(split.held_out)
        assert split.held_out_episodes == ()
        assert split.note is None

    def test_a_single_episode_holds_out_its_last_fifth_behind_a_gap(self) -> None:
        split = split_by_episode(FakeStore([100]), 0.1, horizon=8)
        assert split.held_out.tolist() == list(range(80, 100))
        # The chunk of the last trained tick, 72, ends at 79.
        assert split.train.tolist() == list(range(73))
        assert split.held_out_episodes == ("s/episode_0",)
        assert "last 20%" in str(split.note)

    def test_a_single_recording_in_two_formats_holds_out_both_tails(self) -> None:
        split = split_by_episode(FakeStore([50, 50], keys=[7, 7]), 0.1, horizon=1)
        assert split.held_out.tolist() == [*range(40, 50), *range(90, 100)]

    def test_formats_of_one_recording_are_cut_at_one_instant(self) -> None:
        """The second begins 1 s later and ends 3 s earlier: its tail would begin at 5.8 s."""
        store = FakeStore([100, 60], keys=[7, 7], late=[0.0, 1.0])
        split = split_by_episode(store, 0.1, horizon=4)
        assert split.held_out.tolist() == [*range(58, 100), *range(148, 160)]
        assert split.train.tolist() == [*range(55), *range(100, 145)]
        assert split.held_out_episodes == ("s/episode_0", "s/episode_1")

    def test_an_action_that_lasts_beyond_the_cut_is_not_trained_on(self) -> None:
        """Ticks of the second lie between those of the first; the cut is at 8 s."""
        split = split_by_episode(FakeStore([100, 100], keys=[7, 7], late=[0.0, 0.05]), 0.1, 1)
        assert split.held_out.tolist() == [*range(80, 100), *range(180, 200)]
        # Of the second, the action of tick 79 lasts from 7.95 s to 8.05 s.
        assert split.train.tolist() == [*range(80), *range(100, 179)]

    def test_a_format_that_ends_before_the_cut_is_trained_on_whole(self) -> None:
        split = split_by_episode(FakeStore([100, 2], keys=[7, 7], late=[0.0, 0.0]), 0.1, 8)
        assert split.train.tolist() == [*range(73), 100, 101]
        assert split.held_out_episodes == ("s/episode_0",)

    @given(
        st.lists(st.tuples(st.integers(1, 90), st.floats(0, 3)), min_size=1, max_size=4),
        st.integers(1, 12),
    )
    @example([(1, 1.25), (16, 0.0)], 1)  # of one tick, whose action lasts beyond the cut
    @settings(deadline=None)
    def test_no_trained_chunk_reaches_into_what_is_held_out(
        self, formats: list[tuple[int, float]], horizon: int
    ) -> None:
        lengths, late = [list(column) for column in zip(*formats, strict=True)]
        store = FakeStore(lengths, [7] * len(formats), late=late)
        try:
            split = split_by_episode(store, 0.1, horizon)
        except ConfigError:
            return
        begins, ends = [], []
        for episode, waited in zip(store.episodes, late, strict=True):
            for tick in episode.ticks:
                if tick in split.held_out:
                    begins.append(waited + 0.1 * (tick - episode.ticks.start))
                if tick in split.train:
                    last = min(tick + horizon, episode.ticks.stop)
                    ends.append(waited + 0.1 * (last - episode.ticks.start))
        assert ends
        assert not begins or max(ends) <= min(begins) + 1e-5

    @pytest.mark.parametrize("length", [1, 2])
    def test_too_short_to_hold_ticks_out_trains_on_all(self, length: int) -> None:
        split = split_by_episode(FakeStore([length]), 0.1, horizon=8)
        assert len(split.train) == length
        assert not len(split.held_out)
        assert split.held_out_episodes == ()
        assert "too short" in str(split.note)

    def test_the_longest_horizon_that_leaves_a_tick(self) -> None:
        assert split_by_episode(FakeStore([10]), 0.1, horizon=8).train.tolist() == [0]

    @pytest.mark.parametrize(("length", "horizon"), [(3, 8), (8, 8), (10, 9), (100, 81)])
    def test_a_horizon_that_leaves_nothing_is_refused(self, length: int, horizon: int) -> None:
        said = rf"of {length} ticks.*horizon {horizon} .*shorter.*val_fraction=0.*data\.sources"
        with pytest.raises(ConfigError, match=said):
            split_by_episode(FakeStore([length]), 0.1, horizon)

    def test_episodes_without_ticks_are_no_recordings(self) -> None:
        split = split_by_episode(FakeStore([0, 100, 0]), 0.1)
        assert "a single recording" in str(split.note)
        with pytest.raises(StoreMismatch, match="found none"):
            split_by_episode(FakeStore([0, 0]), 0.1)

    def test_ticks_are_told_by_source(self) -> None:
        store = FakeStore([3, 0, 2, 4], sources="abc")
        told = ticks_by_source(store, np.array([0, 3, 5, 8, 2]))
        assert {name: ticks.tolist() for name, ticks in told.items()} == {
            "a": [0, 5, 8, 2],
            "b": [],
            "c": [3],
        }

    def test_on_a_real_store(self, tiny_store: Callable[..., Path], tmp_path: Path) -> None:
        store = FeatureStore.open(tiny_store(tmp_path))
        split = split_by_episode(store, 0.3)
        assert len(split.train) + len(split.held_out) == store.ticks
        assert len(split.held_out) == 30 * len(split.held_out_episodes)
        told = ticks_by_source(store, split.train)
        assert set(told) == {"left", "right"}
        assert sum(map(len, told.values())) == len(split.train)


def sources(sizes: list[int]) -> dict[str, np.ndarray]:
    edges = np.cumsum([0, *sizes])
    return {f"s{i}": np.arange(edges[i], edges[i + 1]) for i in range(len(sizes))}


sizes = st.lists(st.integers(1, 30), min_size=1, max_size=3)
weight = st.floats(0.01, 100)


class TestTickSampler:
    @given(sizes, st.lists(weight, min_size=3, max_size=3), st.integers(1, 17), st.integers(0, 9))
    @settings(max_examples=60, deadline=None)
    def test_resuming_at_every_step_gives_the_same_stream(
        self, sizes: list[int], weights: list[float], batch_size: int, seed: int
    ) -> None:
        given_weights = {f"s{i}": w for i, w in enumerate(weights[: len(sizes)])}
        stream = TickSampler(sources(sizes), given_weights, batch_size, seed)
        batches = [stream.batch(step) for step in range(12)]
        for step, expected in enumerate(batches):
            resumed = TickSampler(sources(sizes), given_weights, batch_size, seed)
            assert np.array_equal(resumed.batch(step), expected)
            assert expected.shape == (batch_size,)
            assert expected.dtype == np.int64

    @given(sizes, st.lists(weight, min_size=3, max_size=3), st.integers(1, 17))
    @settings(max_examples=60, deadline=None)
    def test_every_tick_is_seen_once_an_epoch(
        self, sizes: list[int], weights: list[float], batch_size: int
    ) -> None:
        ticks = sources(sizes)
        sampler = TickSampler(ticks, dict(zip(ticks, weights, strict=False)), batch_size, 0)
        stream = np.concatenate([sampler.batch(step) for step in range(150 // batch_size + 1)])
        for own in ticks.values():
            drawn = stream[np.isin(stream, own)]
            for start in range(0, len(drawn) - len(own) + 1, len(own)):
                assert np.array_equal(np.sort(drawn[start : start + len(own)]), own)

    @given(st.lists(st.integers(1, 2000), min_size=1, max_size=8), st.integers(0, 10**9))
    @settings(max_examples=300, deadline=None)
    def test_weights_are_kept_to_a_draw_or_so_at_any_time(
        self, sizes: list[int], draws: int
    ) -> None:
        sampler = TickSampler(sources(sizes), {"s0": 3.0}, 1, 0)
        drawn, later = sampler.count_drawn(draws), sampler.count_drawn(draws + 1)
        assert sum(drawn.values()) == draws
        bound = 1.0 if len(sizes) <= 3 else 1.5
        for name, share in sampler.shares.items():
            assert abs(drawn[name] - draws * share) <= bound + 1e-6
            assert later[name] - drawn[name] in (0, 1)

    def test_weight_is_a_tick_s(self) -> None:
        """The seeds' 1 : 3 mixture: a tick of the new set is shown three times as often."""
        sampler = TickSampler(sources([300, 100]), {"s0": 1.0, "s1": 3.0}, 60, 0)
        assert sampler.shares == {"s0": 0.5, "s1": 0.5}
        stream = np.concatenate([sampler.batch(step) for step in range(10)])
        seen = np.bincount(stream, minlength=400)
        assert set(seen[:300]) == {1}
        assert set(seen[300:]) == {3}

    def test_epochs_and_seeds_differ(self) -> None:
        sampler = TickSampler(sources([50]), {}, 50, 0)
        other = TickSampler(sources([50]), {}, 50, 1)
        orders = [sampler.batch(0), sampler.batch(1), other.batch(0), np.arange(50)]
        assert len({order.tobytes() for order in orders}) == 4

    def test_a_weight_may_name_a_source_whose_only_recording_is_held_out(self) -> None:
        sampler = TickSampler(sources([5, 0]), {"s1": 3.0}, 5, 0)
        assert sampler.shares == {"s0": 1.0}

    def test_a_source_of_weight_zero_is_left_out(self) -> None:
        sampler = TickSampler(sources([5, 5]), {"s0": 0.0}, 20, 0)
        assert sampler.batch(0).min() >= 5
        assert sampler.shares == {"s1": 1.0}

    def test_a_batch_may_span_several_epochs(self) -> None:
        batch = TickSampler(sources([3]), {}, 10, 0).batch(2)
        assert np.bincount(batch).tolist() in ([4, 3, 3], [3, 4, 3], [3, 3, 4])

    @pytest.mark.parametrize(
        ("weights", "complaint"),
        [({"elsewhere": 1.0}, "names elsewhere"), ({"s0": 0.0}, "nothing to train on")],
    )
    def test_a_mixture_that_cannot_be_is_refused(
        self, weights: dict[str, float], complaint: str
    ) -> None:
        with pytest.raises(ConfigError, match=complaint):
            TickSampler(sources([4]), weights, 2, 0)

    def test_the_stream_is_pinned(self) -> None:
        """A change of the order would make a resumed run another run."""
        batch = TickSampler(sources([6, 4]), {"s1": 2.0}, 7, 5).batch(3)
        assert batch.tolist() == [4, 1, 2, 9, 6, 8, 7]
