"""The policy: encoders, fusion and action expert, from physical units to physical units."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from pipeline.config import TrainHeadParams
from pipeline.errors import CheckpointMismatch, ConfigError
from pipeline.models.expert import ActionExpert
from pipeline.models.feature_encoder import FeatureEncoder
from pipeline.models.fusion import build_fusion
from pipeline.models.normalizer import Normalizer, Statistics
from pipeline.models.regression import RegressionActionExpert
from pipeline.models.sensor_encoder import SensorEncoder
from pipeline.models.state_encoder import RobotStateEncoder

_GROUP_BY_UNIT = {"m": "translation", "cm": "translation", "mm": "translation"} | {
    "deg": "rotation",
    "rad": "rotation",
}


@runtime_checkable
class Observation(Protocol):
    """What the policy sees, in physical units; `store.Batch` has these fields.

    Streams come in their stored dtype and right-aligned; `*_valid` counts real readings; an absent
    stream has width 0. `feature_age` is s since the newest frame.
    """

    features: Float[Tensor, "batch slot dim"]
    slot_valid: Bool[Tensor, "batch slot"]
    feature_age: Float[Tensor, " batch"]
    sensor: Float[Tensor, "batch sensor_window channel"]
    sensor_valid: Int[Tensor, " batch"]
    state: Float[Tensor, "batch state_window state_dim"]
    state_valid: Int[Tensor, " batch"]


@dataclass(frozen=True)
class PolicyShape:
    """The widths that a store gives to a policy; 0 where the store lacks the stream.

    `action_groups` has one of translation, rotation, gripper, other for each action channel.
    """

    slots: int
    feature_dim: int
    sensor_channels: int
    state_dim: int
    action_dim: int
    action_groups: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """The shape as JSON values."""
        return asdict(self) | {"action_groups": list(self.action_groups)}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "PolicyShape":
        """The shape of a `document`. Raises `CheckpointMismatch`."""
        fields = dict(document)
        try:
            fields["action_groups"] = tuple(fields["action_groups"])
            return cls(**fields)
        except (KeyError, TypeError) as error:
            raise CheckpointMismatch(f"policy shape: {error!r} in {fields}") from None


def action_groups(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """The loss group of each action channel, by its name (gripper) and then by its unit.

    Lengths are translation and angles rotation; velocities and unnamed quantities are other.
    """
    return tuple(
        "gripper" if "gripper" in name.lower() else _GROUP_BY_UNIT.get(unit.lower(), "other")
        for name, unit in zip(names, units, strict=True)
    )


@runtime_checkable
class StreamStatistics(Protocol):
    """Statistics by stream, None where a stream is absent; see `pipeline.normalization`."""

    @property
    def action(self) -> Statistics: ...

    @property
    def features(self) -> Statistics | None: ...

    @property
    def sensor(self) -> Statistics | None: ...

    @property
    def state(self) -> Statistics | None: ...


class Policy(nn.Module):
    """Encoders of the streams that are both present and enabled, fusion, expert.

    Raises `ConfigError` where no stream is left, `CheckpointMismatch` where the statistics do not
    fit the shape. The state dict holds weights only.
    """

    def __init__(
        self, params: TrainHeadParams, shape: PolicyShape, normalization: StreamStatistics
    ) -> None:
        super().__init__()
        self.encoders, widths = _build_encoders(params, shape)
        self.normalizers = nn.ModuleDict(
            {name: Normalizer(_fitting(normalization, name, shape)) for name in self.encoders}
        )
        self.action_normalizer = Normalizer(_fitting(normalization, "action", shape))
        self.fusion = build_fusion(params.fusion_strategy, widths, params.expert.dim)
        self.expert = _build_expert(params, shape)

    def context(self, observation: Observation) -> Float[Tensor, "batch token dim"]:
        """What the expert attends to."""
        encoded = {name: self._encode(name, observation) for name in self.encoders}
        return self.fusion(encoded)

    def loss(
        self,
        observation: Observation,
        action: Float[Tensor, "batch horizon action"],
        action_valid: Bool[Tensor, "batch horizon"],
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """The scalar to minimise and its detached parts by action group; `action` is physical."""
        target = self.action_normalizer.normalize(action)
        return self.expert.loss(self.context(observation), target, action_valid, generator)

    @torch.no_grad()
    def act(
        self, observation: Observation, generator: torch.Generator | None = None
    ) -> Float[Tensor, "batch horizon action"]:
        """An action chunk in physical units, float32; call `eval()` first to silence dropout."""
        return self.action_normalizer.invert(self.expert.act(self.context(observation), generator))

    def parameter_table(self) -> list[tuple[str, int]]:
        """The number of parameters of each part."""
        parts = [*self.encoders.items(), ("fusion", self.fusion), ("expert", self.expert)]
        return [(name, sum(p.numel() for p in part.parameters())) for name, part in parts]

    def _encode(self, name: str, observation: Observation) -> Tensor:
        normalizer = self.normalizers[name]
        assert isinstance(normalizer, Normalizer)
        normalized = normalizer.normalize(getattr(observation, name))
        if name == "features":
            rest = (observation.slot_valid, observation.feature_age)
        else:
            rest = (getattr(observation, f"{name}_valid"),)
        return self.encoders[name](normalized, *rest)


def _build_encoders(
    params: TrainHeadParams, shape: PolicyShape
) -> tuple[nn.ModuleDict, dict[str, int]]:
    encoders, widths = nn.ModuleDict(), {}
    if params.features_enabled and shape.slots and shape.feature_dim:
        widths["features"] = params.expert.dim
        encoders["features"] = FeatureEncoder(shape.slots, shape.feature_dim, params.expert.dim)
    if params.sensor_enabled and shape.sensor_channels:
        sensor = params.sensor_encoder
        widths["sensor"] = sensor.output_dim
        encoders["sensor"] = SensorEncoder(
            shape.sensor_channels, params.sensor_window, **sensor.model_dump(exclude={"kind"})
        )
    if params.robot_state_enabled and shape.state_dim:
        state = params.state_encoder
        widths["state"] = state.output_dim
        encoders["state"] = RobotStateEncoder(
            shape.state_dim, params.state_window, **state.model_dump()
        )
    if not widths:
        raise ConfigError(
            "the policy has nothing to look at: the store has "
            f"{shape.slots} feature slots, {shape.sensor_channels} sensor channels and "
            f"{shape.state_dim} state channels. Enable one of these in train_head "
            "(features_enabled, sensor_enabled, robot_state_enabled)."
        )
    return encoders, widths


def _build_expert(params: TrainHeadParams, shape: PolicyShape) -> ActionExpert:
    kinds = {"regression": RegressionActionExpert}
    return kinds[params.model_type](
        horizon=params.horizon,
        action_dim=shape.action_dim,
        groups=shape.action_groups,
        group_weights={str(name): weight for name, weight in params.group_weights.items()},
        **params.expert.model_dump(),
        **getattr(params, params.model_type).model_dump(),
    )


def _fitting(normalization: StreamStatistics, name: str, shape: PolicyShape) -> Statistics:
    expected = {
        "features": (shape.slots, shape.feature_dim),
        "sensor": (shape.sensor_channels,),
        "state": (shape.state_dim,),
        "action": (shape.action_dim,),
    }[name]
    statistics: Statistics | None = getattr(normalization, name)
    found = None if statistics is None else statistics.mean.shape
    if statistics is None or found != expected:
        raise CheckpointMismatch(
            f"normalisation of {name}: expected statistics of shape {expected}, found {found}. "
            "Train again: python -m stages.train_head"
        )
    return statistics
