import json
import re
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.base.errors import CheckpointIncomplete, NumericsError
from pipeline.base.files import RUN_FILES
from pipeline.policy.normalization import ChannelStatistics, Normalization, fit_channels
from pipeline.policy.policy import Normalizer


@given(st.lists(st.integers(0, 40), max_size=5), st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_blocks_say_what_the_whole_says(cuts, seed):
    values = np.random.default_rng(seed).normal(1e4, 3, (40, 3)).astype(np.float32)
    edges = [0, *sorted(cuts), 40]
    fitted = fit_channels((values[a:b] for a, b in pairwise(edges)), "x")
    whole = values.astype(np.float64)
    np.testing.assert_allclose(fitted.mean, whole.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(fitted.std, whole.std(axis=0), rtol=1e-9)
    assert fitted.count == 40


def test_large_blocks_are_taken_in_pieces(monkeypatch):
    monkeypatch.setattr("pipeline.policy.normalization._PIECE_VALUES", 64)
    values = np.random.default_rng(0).normal(size=(100, 3, 5)).astype(np.float32)
    fitted = fit_channels([values], "features")
    np.testing.assert_allclose(fitted.std, values.astype(np.float64).std(axis=0), rtol=1e-9)
    values[77, 1, 2] = np.nan
    with pytest.raises(NumericsError, match=r"found nan in channel \[1, 2\]"):
        fit_channels([values], "features")


def test_what_is_not_valid_is_neither_counted_nor_checked():
    rng = np.random.default_rng(0)
    values = rng.normal(3, 2, (60, 2, 4)).astype(np.float32)
    valid = np.ones((60, 2), bool)
    valid[::3, 1] = False
    values[~valid] = np.nan
    fitted = fit_channels([(values[:7], valid[:7]), (values[7:], valid[7:])], "features")
    np.testing.assert_allclose(fitted.mean[0], values[:, 0].mean(axis=0, dtype=float), rtol=1e-9)
    seen = values[valid[:, 1], 1].astype(np.float64)
    np.testing.assert_allclose(fitted.mean[1], seen.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(fitted.std[1], seen.std(axis=0), rtol=1e-9)


def test_a_slot_that_is_never_valid_is_left_as_it_is():
    values, valid = np.ones((5, 2, 3), np.float32), np.tile([True, False], (5, 1))
    fitted = fit_channels([(values, valid)], "features")
    assert not fitted.mean[1].any()
    assert (fitted.scale == 1).all()


def test_overflow_is_named():
    with pytest.raises(NumericsError, match="too large to square"):
        fit_channels([np.array([[1e300], [-1e300]])], "sensor")


def test_no_rows_are_an_error():
    for blocks in ([], [np.zeros((0, 3), np.float32)]):
        with pytest.raises(NumericsError, match="actions: no rows"):
            fit_channels(blocks, "actions")


def test_bfloat16_bits_are_not_mistaken_for_numbers():
    with pytest.raises(TypeError, match="uint16"):
        fit_channels([np.zeros((3, 2), np.uint16)], "features")


def test_scale_guards_channels_that_do_not_vary():
    mean = np.array([1e6, 1e6, 0.0, 0.0])
    std = np.array([0.01, 10.0, 0.0, 1e-9])
    assert ChannelStatistics(mean, std, 9).scale.tolist() == [1.0, 10.0, 1.0, 1e-9]


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.lists(st.tuples(finite, finite), min_size=1, max_size=6), st.integers(1, 2**40))
def test_json_keeps_every_bit(pairs, count):
    mean, std = np.clip(np.array(pairs).T, -1e30, 1e30)
    std = np.abs(std)
    fitted = Normalization(
        action=ChannelStatistics(mean, std, count),
        features=ChannelStatistics(np.stack([mean, std]), np.stack([std, std]), count),
    )
    read = RUN_FILES.parse_json(json.dumps(fitted.document()), Normalization, "x.json")
    assert read.action.mean.tobytes() == mean.tobytes()
    assert read.action.std.tobytes() == std.tobytes()
    assert read.features is not None
    assert read.features.mean.tobytes() == np.stack([mean, std]).tobytes()
    assert read.action.count == count
    assert read.sensor is None
    assert read.state is None


@pytest.mark.parametrize(
    ("action", "said"),
    [
        ({"mean": [1.0], "std": [-1.0], "count": 3}, "greater than or equal to 0, found -1.0"),
        ({"mean": [1e300], "std": [1.0], "count": 3}, "less than or equal to 1000000000000"),
        ({"mean": [[1.0], [1.0, 2.0]], "std": [1.0], "count": 3}, "expected rows of one length"),
    ],
)
def test_a_damaged_document_is_refused(action, said):
    with pytest.raises(CheckpointIncomplete, match=re.escape(said)):
        RUN_FILES.parse_json(json.dumps({"action": action}), Normalization, "x.json")


WIDTH = 4
number = st.floats(-1e6, 1e6, width=32)


@given(arrays(np.float32, st.tuples(st.integers(1, 12), st.just(WIDTH)), elements=number))
@settings(max_examples=150, deadline=None)
def test_inverting_gives_back_what_was_normalised(values):
    normalizer = Normalizer(fit_channels([values], "x"))
    physical = torch.from_numpy(values)
    back = normalizer.invert(normalizer.normalize(physical))
    # Subtracting the mean loses what float32 loses at the largest value in the channel.
    tolerance = 4 * torch.finfo(torch.float32).eps * physical.abs().amax(dim=0)
    assert ((back - physical).abs() <= tolerance + 1e-30).all()


@given(number, st.integers(1, 50))
@settings(max_examples=100, deadline=None)
def test_a_constant_channel_is_zero_and_inverts_exactly(value, rows):
    values = np.full((rows, 1), value, np.float32)
    normalizer = Normalizer(fit_channels([values[:3], values[3:]], "x"))
    normalized = normalizer.normalize(torch.from_numpy(values))
    assert not normalized.any()
    assert torch.equal(normalizer.invert(normalized), torch.from_numpy(values))


def test_any_float_dtype_comes_out_as_float32_and_stays_untouched():
    statistics = ChannelStatistics(np.full((2, 3), 2.0), np.full((2, 3), 4.0), 9)
    stored = torch.full((5, 2, 3), 6.0, dtype=torch.float64)
    normalized = Normalizer(statistics).normalize(stored)
    assert normalized.dtype == torch.float32
    assert (normalized == 1).all()
    assert (stored == 6).all()


def test_statistics_stay_out_of_the_state_dict():
    assert not Normalizer(ChannelStatistics(np.ones(1), np.ones(1), 2)).state_dict()
