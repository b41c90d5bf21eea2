"""A map keeps what varies most, whatever the sizes of channels."""

import numpy as np
import pytest

from pipeline.base.errors import ConfigError
from pipeline.base.projection import Basis, apply_map, fit_map, group_sizes


@pytest.fixture
def values() -> np.ndarray:
    """(row, channel): 16 channels that 4 numbers explain nearly."""
    rng = np.random.default_rng(0)
    few = rng.normal(size=(400, 4)) @ rng.normal(size=(4, 16))
    return (few + 0.01 * rng.normal(size=few.shape) + 3).astype(np.float32)


def test_coefficients_have_mean_0_and_spread_1(values: np.ndarray) -> None:
    affine, share = fit_map(values, 4)
    numbers = apply_map(values, affine)
    assert affine.shape == (17, 4)
    assert share > 0.999
    assert np.abs(numbers.mean(axis=0)).max() < 1e-4
    assert numbers[:, :3].std(axis=0) == pytest.approx(1, abs=1e-3)
    assert np.abs(np.corrcoef(numbers.T) - np.eye(4)).max() < 1e-3


def test_a_huge_channel_costs_the_others_nothing(values: np.ndarray) -> None:
    huge = values.copy()
    huge[:, 5] = huge[:, 5] * 1000 + 5000
    found = [apply_map(x, fit_map(x, 4)[0]) for x in (values, huge)]
    assert np.abs(found[0] - found[1]).max() < 0.01


def test_what_does_not_vary_is_not_made_to(values: np.ndarray) -> None:
    still = values.copy()
    still[:, 2] = 4096
    still[::2, 3] = np.nextafter(np.float32(4096), np.float32(0))
    still[1::2, 3] = 4096  # rounding alone
    affine, _ = fit_map(still, 8)
    moved = still.copy()
    moved[:, 2:4] += 4
    assert np.isfinite(affine).all()
    assert np.abs(apply_map(moved, affine) - apply_map(still, affine)).max() < 8


def test_too_few_rows_are_refused(values: np.ndarray) -> None:
    assert fit_map(values[:5], 4)[0].shape == (17, 4)
    for few in (0, 4):
        with pytest.raises(ConfigError, match=rf"one of these has {few}\. Set a smaller pca"):
            fit_map(values[:few], 4)


def test_a_basis_is_known_by_its_numbers(values: np.ndarray) -> None:
    maps = np.stack([fit_map(values, 4)[0]] * 2)
    assert Basis(maps).digest == Basis(np.stack([fit_map(values, 4)[0]] * 2)).digest
    assert Basis(maps).digest != Basis(maps + 1).digest != Basis(maps.reshape(1, -1, 4)).digest


def test_groups_are_of_one_layer_norm_and_pooling() -> None:
    slot = {"layer": 3, "norm": True, "pooling": "mean"}
    grid = slot | {"pooling": "grid"}
    assert group_sizes([slot, grid, grid, slot | {"norm": False}]) == (1, 2, 1)
