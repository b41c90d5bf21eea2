import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.train.sampling import Plan, TickSampler
from pipeline.train.split import split_by_episode


def sources(sizes: list[int]) -> dict[str, np.ndarray]:
    edges = np.cumsum([0, *sizes])
    return {f"s{i}": np.arange(edges[i], edges[i + 1]) for i in range(len(sizes))}


sizes = st.lists(st.integers(1, 30), min_size=1, max_size=3)
weight = st.floats(0.01, 100)


class TestTickSampler:
    @given(sizes, st.lists(weight, min_size=3, max_size=3), st.integers(1, 17), st.integers(0, 9))
    @settings(max_examples=60, deadline=None)
    def test_resuming_at_every_step_gives_the_same_stream(self, sizes, weights, batch_size, seed):
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
    def test_every_tick_is_seen_once_an_epoch(self, sizes, weights, batch_size):
        ticks = sources(sizes)
        sampler = TickSampler(ticks, dict(zip(ticks, weights, strict=False)), batch_size, 0)
        stream = np.concatenate([sampler.batch(step) for step in range(150 // batch_size + 1)])
        for own in ticks.values():
            drawn = stream[np.isin(stream, own)]
            for start in range(0, len(drawn) - len(own) + 1, len(own)):
                assert np.array_equal(np.sort(drawn[start : start + len(own)]), own)

    @given(st.lists(st.integers(1, 2000), min_size=1, max_size=8), st.integers(0, 10**9))
    @settings(max_examples=300, deadline=None)
    def test_weights_are_kept_to_a_draw_or_so_at_any_time(self, sizes, draws):
        sampler = TickSampler(sources(sizes), {"s0": 3.0}, 1, 0)
        drawn, later = sampler.count_drawn(draws), sampler.count_drawn(draws + 1)
        assert sum(drawn.values()) == draws
        bound = 1.0 if len(sizes) <= 3 else 1.5
        for name, share in sampler.shares.items():
            assert abs(drawn[name] - draws * share) <= bound + 1e-6
            assert later[name] - drawn[name] in (0, 1)

    def test_weight_is_a_tick_s(self):
        """The seeds' 1 : 3 mixture: a tick of the new set is shown three times as often."""
        sampler = TickSampler(sources([300, 100]), {"s0": 1.0, "s1": 3.0}, 60, 0)
        assert sampler.shares == {"s0": 0.5, "s1": 0.5}
        stream = np.concatenate([sampler.batch(step) for step in range(10)])
        seen = np.bincount(stream, minlength=400)
        assert set(seen[:300]) == {1}
        assert set(seen[300:]) == {3}

    def test_epochs_and_seeds_differ(self):
        sampler = TickSampler(sources([50]), {}, 50, 0)
        other = TickSampler(sources([50]), {}, 50, 1)
        orders = [sampler.batch(0), sampler.batch(1), other.batch(0), np.arange(50)]
        assert len({order.tobytes() for order in orders}) == 4

    def test_a_weight_may_name_a_source_whose_only_recording_is_held_out(self):
        sampler = TickSampler(sources([5, 0]), {"s1": 3.0}, 5, 0)
        assert sampler.shares == {"s0": 1.0}

    def test_a_source_of_weight_zero_is_left_out(self):
        sampler = TickSampler(sources([5, 5]), {"s0": 0.0}, 20, 0)
        assert sampler.batch(0).min() >= 5
        assert sampler.shares == {"s1": 1.0}

    @pytest.mark.parametrize(
        ("weights", "complaint"),
        [({"elsewhere": 1.0}, "names elsewhere"), ({"s0": 0.0}, "nothing to train on")],
    )
    def test_a_mixture_that_cannot_be_is_refused(self, weights, complaint):
        with pytest.raises(ConfigError, match=complaint):
            TickSampler(sources([4]), weights, 2, 0)

    def test_the_stream_is_pinned(self):
        """A change of the order would make a resumed run another run."""
        batch = TickSampler(sources([6, 4]), {"s1": 2.0}, 7, 5).batch(3)
        assert batch.tolist() == [4, 1, 2, 9, 6, 8, 7]


def test_each_sample_has_a_lag_of_its_own_and_the_same_after_a_stop(store):
    params = TrainHeadParams(batch_size=64, feature_lag=2, sensor_lag_s=0.3)
    split = split_by_episode(store, params.split)
    plan = Plan(store, params, split)
    parts = [plan.step(step)[0] for step in range(20)]
    rows = np.concatenate([part.lags.features for part in parts])
    late_s = np.concatenate([part.lags.sensor_s for part in parts])
    assert np.bincount(rows) == pytest.approx([len(rows) / 3] * 3, rel=0.15)
    assert 0 <= late_s.min() < 0.01
    assert 0.29 < late_s.max() <= 0.3
    again = Plan(store, params, split).step(7)[0]
    assert np.array_equal(again.lags.features, parts[7].lags.features)
    assert np.array_equal(again.lags.sensor_s, parts[7].lags.sensor_s)
