from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ConfigError, StoreMismatch
from pipeline.sampling import TickSampler, split_by_episode, ticks_by_source
from pipeline.store import FeatureStore


@dataclass
class FakeEpisode:
    id: str
    source: str
    ticks: range
    vl_rows: range


class FakeStore:
    """Episodes of these lengths and first VL keys, as the split sees them."""

    path = Path("fake.zarr")

    def __init__(self, lengths: list[int], keys: list[int] | None = None, sources: str = "s"):
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

    def array(self, name: str) -> np.ndarray:
        assert name == "vl/key"
        return self._keys

    def names(self, ticks: np.ndarray) -> set[str]:
        return {
            f"{e.source}/{e.id}" for e in self.episodes if np.isin(np.array(e.ticks), ticks).any()
        }


class TestSplit:
    @given(
        st.lists(st.integers(1, 20), min_size=2, max_size=30), st.floats(0.01, 1.0), st.booleans()
    )
    @settings(deadline=None)
    def test_whole_episodes_fall_on_one_side_each(
        self, lengths: list[int], fraction: float, paired: bool
    ) -> None:
        keys = [i // 2 for i in range(len(lengths))] if paired else None
        store = FakeStore(lengths, keys)
        split = split_by_episode(store, fraction)
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

    def test_the_fraction_is_about_kept(self) -> None:
        held_out = split_by_episode(FakeStore([3] * 2000), 0.1).held_out_episodes
        assert 150 < len(held_out) < 250

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

    @pytest.mark.parametrize("length", [1, 2, 3, 8])
    def test_however_short_something_is_trained_on(self, length: int) -> None:
        split = split_by_episode(FakeStore([length]), 0.1, horizon=8)
        assert split.train.tolist() == [0]
        assert len(split.held_out) == round(0.2 * length)
        assert bool(split.held_out_episodes) == (length >= 3)
        assert ("too short" in str(split.note)) == (length < 3)

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
        drawn, later = sampler.drawn(draws), sampler.drawn(draws + 1)
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
