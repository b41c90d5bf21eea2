import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.policy.normalization import ChannelStatistics, fit_channels
from pipeline.policy.policy import Normalizer

WIDTH = 4
number = st.floats(-1e6, 1e6, width=32)


@given(arrays(np.float32, st.tuples(st.integers(1, 12), st.just(WIDTH)), elements=number))
@settings(max_examples=150, deadline=None)
def test_inverting_gives_back_what_was_normalised(values: np.ndarray) -> None:
    normalizer = Normalizer(fit_channels([values], "x"))
    physical = torch.from_numpy(values)
    back = normalizer.invert(normalizer.normalize(physical))
    # Subtracting the mean loses what float32 loses at the largest value in the channel.
    tolerance = 4 * torch.finfo(torch.float32).eps * physical.abs().amax(dim=0)
    assert ((back - physical).abs() <= tolerance + 1e-30).all()


@given(number, st.integers(1, 50))
@settings(max_examples=100, deadline=None)
def test_a_constant_channel_is_zero_and_inverts_exactly(value: float, rows: int) -> None:
    values = np.full((rows, 1), value, np.float32)
    normalizer = Normalizer(fit_channels([values[:3], values[3:]], "x"))
    normalized = normalizer.normalize(torch.from_numpy(values))
    assert not normalized.any()
    assert torch.equal(normalizer.invert(normalized), torch.from_numpy(values))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_any_float_dtype_comes_out_as_float32_and_stays_untouched(dtype: torch.dtype) -> None:
    statistics = ChannelStatistics(np.full((2, 3), 2.0), np.full((2, 3), 4.0), 9)
    stored = torch.full((5, 2, 3), 6.0, dtype=dtype)
    normalized = Normalizer(statistics).normalize(stored)
    assert normalized.dtype == torch.float32
    assert (normalized == 1).all()
    assert (stored == 6).all()


def test_statistics_stay_out_of_the_state_dict() -> None:
    assert not Normalizer(ChannelStatistics(np.ones(1), np.ones(1), 2)).state_dict()
