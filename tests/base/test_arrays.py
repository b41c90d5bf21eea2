"""Non-finite numbers and the bits of bfloat16."""

import numpy as np
import pytest
import torch

from pipeline.base.arrays import array_of, first_non_finite, non_finite, widen


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_the_first_bad_value_in_order(dtype):
    for bad in (np.nan, np.inf, -np.inf):
        values = np.zeros((3, 4), dtype)
        assert first_non_finite(values) is None
        values[2, 1] = values[1, 3] = bad
        assert first_non_finite(values) == (1, 3)
        assert non_finite(values).sum() == 2


def test_invalid_entries_are_ignored():
    values = np.zeros((2, 3, 4), np.float32)
    values[0, 1] = np.nan
    valid = np.ones((2, 3), np.bool_)
    valid[0, 1] = False
    assert first_non_finite(values, valid) is None
    assert first_non_finite(values, ~valid) == (0, 1, 0)


def test_bfloat16_goes_there_and_back_and_other_types_stay():
    numbers = torch.tensor([0.0, -1.5, 3e38, float("nan"), float("-inf")]).bfloat16()
    bits = array_of(numbers)
    assert bits.dtype == np.uint16
    np.testing.assert_array_equal(widen(bits), numbers.float().numpy())
    assert first_non_finite(bits) == (3,)
    assert non_finite(bits).tolist() == [False, False, False, True, True]
    values = np.arange(3, dtype=np.float16)
    assert widen(values) is values
    assert array_of(torch.ones(2)).dtype == np.float32
