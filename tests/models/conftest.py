"""Small policies and observations."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.config import TrainHeadParams
from pipeline.models import Policy, PolicyShape
from pipeline.normalization import ChannelStatistics, Normalization


@dataclass
class Seen:
    """An observation with the fields of the store's batch, and what was done."""

    features: Tensor
    slot_valid: Tensor
    feature_age: Tensor
    sensor: Tensor
    sensor_valid: Tensor
    state: Tensor
    state_valid: Tensor
    action: Tensor
    action_valid: Tensor


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture
def shape() -> PolicyShape:
    """Of a needle insertion with a narrow sensor."""
    groups = ("translation",) * 3 + ("rotation",) * 3 + ("gripper",)
    return PolicyShape(5, 16, 9, 12, 7, groups)


@pytest.fixture
def observe(shape: PolicyShape) -> Callable[..., Seen]:
    """`observe(batch=4, sensor_window=13, state_window=25)`: everything valid, random."""

    def make(batch: int = 4, sensor_window: int = 13, state_window: int = 25) -> Seen:
        return Seen(
            features=torch.randn(batch, shape.slots, shape.feature_dim),
            slot_valid=torch.ones(batch, shape.slots, dtype=torch.bool),
            feature_age=torch.rand(batch),
            sensor=torch.randn(batch, sensor_window, shape.sensor_channels),
            sensor_valid=torch.full((batch,), sensor_window),
            state=torch.randn(batch, state_window, shape.state_dim),
            state_valid=torch.full((batch,), state_window),
            action=torch.randn(batch, 8, shape.action_dim),
            action_valid=torch.ones(batch, 8, dtype=torch.bool),
        )

    return make


@pytest.fixture
def normalization(shape: PolicyShape) -> Normalization:
    """Statistics that are not the identity, so that a forgotten one shows."""
    rng = np.random.default_rng(0)

    def statistics(*widths: int) -> ChannelStatistics:
        return ChannelStatistics(rng.normal(size=widths), rng.uniform(0.5, 2.0, widths), 100)

    return Normalization(
        action=statistics(shape.action_dim),
        features=statistics(shape.slots, shape.feature_dim),
        sensor=statistics(shape.sensor_channels),
        state=statistics(shape.state_dim),
    )


@pytest.fixture
def small_params() -> Callable[..., TrainHeadParams]:
    """`small_params(**over)`: widths that run in milliseconds, no dropout."""

    def make(**over: Any) -> TrainHeadParams:
        document: dict[str, Any] = {
            "sensor_window": 13,
            "state_window": 25,
            "sensor_encoder": {"channels": [16, 32], "layers": 1, "heads": 2, "output_dim": 24},
            "state_encoder": {"dim": 16, "layers": 1, "heads": 2, "output_dim": 20},
            "expert": {"dim": 32, "layers": 2, "heads": 2, "dropout": 0.0},
        }
        return TrainHeadParams.model_validate(document | over)

    return make


@pytest.fixture
def build_policy(
    shape: PolicyShape, normalization: Normalization, small_params: Callable[..., TrainHeadParams]
) -> Callable[..., Policy]:
    """`build_policy(**params)`: a small policy from a fixed seed."""

    def make(**over: Any) -> Policy:
        torch.manual_seed(1)
        return Policy(small_params(**over), shape, normalization)

    return make
