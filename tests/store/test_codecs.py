"""Whatever is chosen gives back every bit, and is the smallest of what was measured."""

import warnings

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from zarr.codecs.numcodecs import BitRound, FixedScaleOffset

from pipeline.store.archive.codecs import (
    Codec,
    blosc_level,
    choose,
    codecs_for,
    measure,
    outside_the_specification,
)

DTYPES = ["<f2", "<f4", "<f8", "<u2", "<i4", "<i8", "|u1", "<u4"]


def candidates(values: np.ndarray, level: int = 5) -> list[Codec]:
    return codecs_for(values.dtype, values.ndim, values.nbytes, level)


def chosen(values: np.ndarray, worth: float = 1.0) -> str:
    return choose([values], candidates(values), worth).codec.name


def random_bits(dtype: str, shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Every bit pattern: NaN with payloads, subnormals and -0.0 among them."""
    raw = np.random.default_rng(seed).bytes(int(np.prod(shape)) * np.dtype(dtype).itemsize)
    return np.frombuffer(raw, dtype).reshape(shape)


class TestExactness:
    @pytest.mark.parametrize("dtype", DTYPES)
    @pytest.mark.parametrize("shape", [(257,), (64, 7), (16, 3, 5)])
    def test_every_candidate_gives_back_every_bit(self, dtype, shape):
        values = random_bits(dtype, shape, seed=1)
        for codec in candidates(values):
            assert measure(codec, values).exact, codec.name

    @settings(max_examples=20, deadline=None)
    @given(seed=st.integers(0, 2**32), level=st.integers(1, 9), rows=st.integers(1, 300))
    def test_small_numbers_too(self, seed, level, rows):
        values = np.random.default_rng(seed).integers(-3, 3, (rows, 4)).astype("<i2")
        assert all(measure(codec, values).exact for codec in candidates(values, level))

    def test_negative_zeros_are_not_zeros(self):
        values = np.full((100, 8), -0.0, np.float32)
        for codec in candidates(values):
            assert measure(codec, values).exact

    @pytest.mark.parametrize(
        "lossy",
        [
            lambda: BitRound(keepbits=6),
            lambda: FixedScaleOffset(offset=0, scale=10, dtype="<f4", astype="<i2"),
        ],
    )
    def test_a_codec_that_loses_bits_is_never_chosen(self, lossy):
        values = np.random.default_rng(0).normal(size=(200, 50)).astype("<f4")
        with outside_the_specification():
            loses = Codec("loses", (lossy(),), candidates(values)[2].compressors)
        choice = choose([values], [*candidates(values), loses], worth=0.0)
        assert choice.ratios["loses"] is None
        assert choice.codec.name != "loses"

    def test_a_codec_exact_on_one_sample_alone_is_not_chosen(self):
        """Values that AsType and its kin keep in one part of an array need not be all of it."""
        whole = np.arange(4000, dtype="<f4")
        fractions = whole + np.float32(0.3)
        with outside_the_specification():
            cast = FixedScaleOffset(offset=0, scale=1, dtype="<f4", astype="<i2")
        loses = Codec("loses", (cast,), candidates(whole)[2].compressors)
        assert measure(loses, whole).exact
        choice = choose([whole, fractions], [*candidates(whole), loses], worth=0.0)
        assert choice.ratios["loses"] is None


class TestChoice:
    def test_noise_stays_as_it_is(self):
        assert chosen(random_bits("<u4", (20000,), 0)) == "none"

    def test_small_numbers_in_wide_types_are_shuffled(self):
        values = np.random.default_rng(0).integers(0, 200, 20000).astype("<i8")
        assert "shuffle" in chosen(values)

    def test_channels_that_drift_slowly_are_transposed(self):
        """Neighbours in time are alike and neighbours among channels are not."""
        rng = np.random.default_rng(0)
        values = rng.integers(0, 2**31, (1, 64)) + np.cumsum(rng.integers(0, 3, (4096, 64)), axis=0)
        assert chosen(values.astype("<i4")).startswith("transpose+")

    def test_a_delta_must_be_worth_leaving_the_specification(self):
        offsets = np.cumsum(np.random.default_rng(0).integers(90, 110, 50000)).astype("<i8")
        ratios = choose([offsets], candidates(offsets), 0.0).ratios
        assert ratios["delta+shuffle"] > 1.5 * ratios["shuffle"]
        assert chosen(offsets, worth=0.0).startswith("delta+")
        assert not chosen(offsets, worth=0.5).startswith("delta+")

    def test_the_choice_is_the_smallest_of_what_zarr_has(self):
        values = np.random.default_rng(0).normal(size=(500, 64)).astype("<f4")
        choice = choose([values], candidates(values), worth=1.0)
        measured = {c.name: measure(c, values).stored_bytes for c in candidates(values)}
        assert measured[choice.codec.name] <= 1.01 * min(measured.values())
        for name, ratio in choice.ratios.items():
            assert ratio == pytest.approx(values.nbytes / measured[name])


@pytest.mark.parametrize(
    ("zstd", "blosc"), [(1, 1), (2, 1), (3, 2), (5, 3), (15, 8), (19, 8), (21, 8), (22, 9)]
)
def test_levels_are_those_of_zstd(zstd, blosc):
    assert blosc_level(zstd) == blosc


def test_only_the_warning_about_numcodecs_is_silenced(tmp_path):
    values = np.arange(10)
    delta = next(codec for codec in candidates(values) if not codec.standard)
    with outside_the_specification():
        array = zarr.create_array(
            tmp_path, shape=(10,), chunks=(10,), dtype=values.dtype, filters=list(delta.filters)
        )
    array[...] = values
    with pytest.warns(UserWarning, match="not in the Zarr version 3 specification"):
        zarr.open_array(tmp_path, mode="r")
    with pytest.warns(UserWarning, match="another"), outside_the_specification():
        warnings.warn("another", stacklevel=1)
