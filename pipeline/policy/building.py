"""The parts of a policy that params name: encoders and action expert."""

from torch import nn

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.policy.diffusion import DiffusionActionExpert
from pipeline.policy.expert import ActionExpert
from pipeline.policy.feature_encoder import FeatureEncoder
from pipeline.policy.flow_matching import FlowMatchingActionExpert
from pipeline.policy.force_encoder import ForceAwareSensorEncoder
from pipeline.policy.observation import PolicyShape
from pipeline.policy.regression import RegressionActionExpert
from pipeline.policy.sensor_encoder import SensorEncoder
from pipeline.policy.state_encoder import RobotStateEncoder

EXPERTS: dict[str, type[ActionExpert]] = {
    "regression": RegressionActionExpert,
    "diffusion": DiffusionActionExpert,
    "flow_matching": FlowMatchingActionExpert,
}
"""The class of each `train_head.model_type`."""

SENSOR_ENCODERS: dict[str, type[SensorEncoder] | type[ForceAwareSensorEncoder]] = {
    "joint": SensorEncoder,
    "force_aware": ForceAwareSensorEncoder,
}
"""The class of each `train_head.sensor_encoder.kind`."""


def build_encoders(
    params: TrainHeadParams, shape: PolicyShape
) -> tuple[nn.ModuleDict, dict[str, tuple[int, int]]]:
    """Encoders of the streams both present and enabled, and how many tokens of what width each.

    Raises `ConfigError` where no stream is left.
    """
    encoders, tokens = nn.ModuleDict(), dict[str, tuple[int, int]]()
    if params.features_enabled and shape.slots and shape.feature_dim:
        features = FeatureEncoder(shape.slots, shape.feature_dim)
        encoders["features"], tokens["features"] = features, (shape.slots, features.width)
    if params.sensor_enabled and shape.sensor_channels:
        sensor = params.sensor_encoder
        encoders["sensor"] = SENSOR_ENCODERS[sensor.kind](
            shape.sensor_channels, params.sensor_window, **sensor.model_dump(exclude={"kind"})
        )
        tokens["sensor"] = (1, sensor.output_dim)
    if params.robot_state_enabled and shape.state_dim:
        state = params.state_encoder
        encoders["state"] = RobotStateEncoder(
            shape.state_dim, params.state_window, **state.model_dump()
        )
        tokens["state"] = (1, state.output_dim)
    if not tokens:
        raise ConfigError(
            "the policy has nothing to look at: the store has "
            f"{shape.slots} feature slots, {shape.sensor_channels} sensor channels and "
            f"{shape.state_dim} state channels. Enable one of these in train_head "
            "(features_enabled, sensor_enabled, robot_state_enabled)."
        )
    return encoders, tokens


def build_expert(params: TrainHeadParams, shape: PolicyShape) -> ActionExpert:
    """The action expert of `train_head.model_type`, with the params of the section of that name."""
    return EXPERTS[params.model_type](
        horizon=params.horizon,
        action_dim=shape.action_dim,
        groups=shape.action_groups,
        group_weights={str(name): weight for name, weight in params.group_weights.items()},
        **params.expert.model_dump(),
        **getattr(params, params.model_type).model_dump(),
    )
