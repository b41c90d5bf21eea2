"""What is trained, under the names that people import: a thin door of `pipeline.policy`.

`QwenVLAUnified` and its other names come from `pipeline.compat.unified` when first asked for: they
bring a vision-language model, and training from a store needs none.
"""

from importlib import import_module
from typing import Any

from pipeline.base.channels import action_groups
from pipeline.base.observation import Observation
from pipeline.policy.cost import describe_cost, flop_table
from pipeline.policy.denoiser import Denoiser
from pipeline.policy.diffusion import DiffusionActionExpert
from pipeline.policy.encoders import (
    FeatureEncoder,
    ForceAwareSensorEncoder,
    RobotStateEncoder,
    SensorEncoder,
)
from pipeline.policy.expert import ActionExpert, GroupedLoss
from pipeline.policy.flow_matching import FlowMatchingActionExpert
from pipeline.policy.fusion import (
    ConcatFusion,
    CrossAttentionFusion,
    Fusion,
    GatedFusion,
    NoFusion,
    build_fusion,
)
from pipeline.policy.noise_schedule import NoiseSchedule
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Normalizer, Policy, Trainable
from pipeline.policy.regression import RegressionActionExpert

_LIVE = {
    "QwenVLAUnified",
    "QwenVLAWithSensorDiffusion",
    "QwenVLAWithSensor",
    "Not_freeze_QwenVLAWithSensor",
}

__all__ = [
    "ActionExpert",
    "ConcatFusion",
    "CrossAttentionFusion",
    "Denoiser",
    "DiffusionActionExpert",
    "FeatureEncoder",
    "FlowMatchingActionExpert",
    "ForceAwareSensorEncoder",
    "Fusion",
    "GatedFusion",
    "GroupedLoss",
    "NoFusion",
    "NoiseSchedule",
    "Normalizer",
    "Observation",
    "Policy",
    "PolicyShape",
    "RegressionActionExpert",
    "RobotStateEncoder",
    "SensorEncoder",
    "Trainable",
    "action_groups",
    "build_fusion",
    "describe_cost",
    "flop_table",
]


def __getattr__(name: str) -> Any:
    if name in _LIVE:
        return getattr(import_module("pipeline.compat.unified"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
