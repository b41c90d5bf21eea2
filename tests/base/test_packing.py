"""Codes of int8 and float8 give the numbers back, on any shape and with huge channels."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.arrays import first_non_finite, packed_dim, packed_size, widen
from pipeline.base.packing import pack, scales, unpack


@given(st.integers(0, 4000), st.sampled_from(["int8", "float8", "float16"]))
def test_the_size_says_how_many_numbers_there_are(dim, dtype):
    assert packed_dim(dtype, packed_size(dtype, dim)) == dim


@given(
    dim=st.integers(1, 100),
    dtype=st.sampled_from(["int8", "float8"]),
    size=st.sampled_from([1e-30, 1e-3, 1.0, 1e6]),
    seed=st.integers(0, 99),
)
def test_numbers_come_back_within_half_a_code(dim, dtype, size, seed):
    values = torch.randn(3, 2, dim, generator=torch.Generator().manual_seed(seed)) * size
    values[0, 0] = 0
    packed = pack(values, dtype)
    assert packed.shape == (3, 2, packed_size(dtype, dim))
    back = unpack(packed)
    assert torch.equal(torch.from_numpy(widen(packed.numpy())), back)
    largest = values.abs().amax(dim=-1, keepdim=True)
    # The scale itself is rounded by a 256th: the largest number may be cut by as much.
    half = largest / 250 if dtype == "int8" else values.abs() / 15 + largest / 400_000
    cut = torch.where(values.abs() > 0.99 * largest, largest / 200, 0.0)
    assert ((back - values).abs() <= half + cut).all()


def test_float8_is_torchs_e4m3fn():
    every = torch.arange(256, dtype=torch.uint8)
    one = torch.ones(1, dtype=torch.bfloat16).view(torch.uint8)
    rest = torch.zeros(packed_size("float8", 256) - 258, dtype=torch.uint8)
    read = widen(torch.cat([every, one, rest]).numpy())
    np.testing.assert_array_equal(read, every.view(torch.float8_e4m3fn).float().numpy())


def test_a_huge_channel_costs_its_block_alone_or_nothing():
    """Hidden states of large models have a few channels hundreds of times the others."""
    plain = torch.randn(64, 2048, generator=torch.Generator().manual_seed(0))
    huge = plain.clone()
    huge[:, [7, 900]] *= 1000
    for dtype, lost in (("int8", 64), ("float8", 0)):
        error = (unpack(pack(huge, dtype)) - huge).square().mean(dim=0).sqrt()
        coarse = (error[huge.abs().mean(dim=0) < 10] > 0.1).sum()
        assert coarse <= lost
        usual = error[huge.abs().mean(dim=0) < 10].median()
        assert usual < (0.01 if dtype == "int8" else 0.04)


@pytest.mark.parametrize("dtype", ["int8", "float8"])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_what_is_not_finite_shows(dtype, bad):
    values = torch.randn(2, 3, 64)
    values[1, 2, 40] = bad
    packed = pack(values, dtype)
    assert (~scales(packed).isfinite().all(dim=-1)).nonzero().tolist() == [[1, 2]]
    place = first_non_finite(packed.numpy())
    assert place is not None and place[:2] == (1, 2)
