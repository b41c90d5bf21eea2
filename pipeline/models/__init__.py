"""What is trained: encoders, fusion, action experts, and the policy made of them."""

from pipeline.models.expert import ActionExpert
from pipeline.models.feature_encoder import FeatureEncoder
from pipeline.models.fusion import ConcatFusion, Fusion
from pipeline.models.normalizer import Normalizer
from pipeline.models.policy import Observation, Policy, PolicyShape, action_groups
from pipeline.models.regression import RegressionActionExpert
from pipeline.models.sensor_encoder import SensorEncoder
from pipeline.models.state_encoder import RobotStateEncoder

__all__ = [
    "ActionExpert",
    "ConcatFusion",
    "FeatureEncoder",
    "Fusion",
    "Normalizer",
    "Observation",
    "Policy",
    "PolicyShape",
    "RegressionActionExpert",
    "RobotStateEncoder",
    "SensorEncoder",
    "action_groups",
]
