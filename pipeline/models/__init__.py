"""What is trained: encoders, fusion, action experts, and the policy made of them.

`QwenVLAUnified` and the names that it is known by are here too, but come from `unified` when first
asked for: they bring a vision-language model, and training from a store needs none.
"""

from importlib import import_module
from typing import Any

from pipeline.models.cost import describe_cost, flop_table
from pipeline.models.denoiser import Denoiser
from pipeline.models.diffusion import DiffusionActionExpert
from pipeline.models.expert import ActionExpert, GroupedLoss
from pipeline.models.feature_encoder import FeatureEncoder
from pipeline.models.flow_matching import FlowMatchingActionExpert
from pipeline.models.force_encoder import ForceAwareSensorEncoder
from pipeline.models.fusion import (
    ConcatFusion,
    CrossAttentionFusion,
    Fusion,
    GatedFusion,
    NoFusion,
    build_fusion,
)
from pipeline.models.noise_schedule import NoiseSchedule
from pipeline.models.normalizer import Normalizer
from pipeline.models.observation import Observation, PolicyShape, action_groups
from pipeline.models.policy import Policy, Trainable
from pipeline.models.regression import RegressionActionExpert
from pipeline.models.sensor_encoder import SensorEncoder
from pipeline.models.state_encoder import RobotStateEncoder

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
        return getattr(import_module(f"{__name__}.unified"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
