"""Small policies and observations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.base.config import TrainHeadParams
from pipeline.base.observation import Observation
from pipeline.policy.ages import even_ages
from pipeline.policy.normalization import ChannelStatistics, Normalization
from pipeline.policy.policy import Policy
from pipeline.policy.shape import PolicyShape


@dataclass
class Seen(Observation):
    """An observation, and what was done."""

    action: Tensor
    action_valid: Tensor


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


@pytest.fixture
def shape():
    """Of a needle insertion with a narrow sensor."""
    groups = ("translation",) * 3 + ("rotation",) * 3 + ("gripper",)
    return PolicyShape(5, 16, 9, 12, 7, groups, views=2)


@pytest.fixture
def observe(shape):
    """`observe(batch=4, sensor_window=13, state_window=25)`: everything valid, random."""

    def make(batch: int = 4, sensor_window: int = 13, state_window: int = 25) -> Seen:
        return Seen(
            features=torch.randn(batch, shape.slots, shape.feature_dim),
            slot_valid=torch.ones(batch, shape.slots, dtype=torch.bool),
            feature_age=torch.rand(batch),
            view_age=torch.rand(batch, shape.views),
            sensor=torch.randn(batch, sensor_window, shape.sensor_channels),
            sensor_valid=torch.full((batch,), sensor_window),
            sensor_age=even_ages(sensor_window, 0.1, torch.empty(0)).repeat(batch, 1),
            state=torch.randn(batch, state_window, shape.state_dim),
            state_valid=torch.full((batch,), state_window),
            state_age=even_ages(state_window, 1.0, torch.empty(0)).repeat(batch, 1),
            action=torch.randn(batch, 8, shape.action_dim),
            action_valid=torch.ones(batch, 8, dtype=torch.bool),
        )

    return make


@pytest.fixture
def normalization(shape):
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
def small_params():
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
def build_policy(shape, normalization, small_params):
    """`build_policy(**params)`: a small policy from a fixed seed."""

    def make(**over: Any) -> Policy:
        torch.manual_seed(1)
        return Policy(small_params(**over), shape, normalization)

    return make
