"""The models under the names of the research code: a thin door of `pipeline.policy`.

`QwenVLAUnified` and its aliases are imported when first asked for: they bring a vision-language
model, and training from a store needs none.
"""

from importlib import import_module
from typing import Any

from pipeline.policy.diffusion import DiffusionActionExpert
from pipeline.policy.encoders import ForceAwareSensorEncoder, RobotStateEncoder, SensorEncoder
from pipeline.policy.flow_matching import FlowMatchingActionExpert
from pipeline.policy.policy import Policy
from pipeline.policy.regression import RegressionActionExpert

_UNIFIED = {
    "QwenVLAUnified",
    "QwenVLAWithSensorDiffusion",
    "QwenVLAWithSensor",
    "Not_freeze_QwenVLAWithSensor",
}

__all__ = [
    "DiffusionActionExpert",
    "FlowMatchingActionExpert",
    "ForceAwareSensorEncoder",
    "Policy",
    "RegressionActionExpert",
    "RobotStateEncoder",
    "SensorEncoder",
]


def __getattr__(name: str) -> Any:
    if name in _UNIFIED:
        return getattr(import_module("pipeline.compat.unified"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
