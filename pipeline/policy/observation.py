"""What a policy sees, and the widths of it that a store decides."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.base.errors import CheckpointMismatch
from pipeline.policy.expert import uniform

STREAMS = ("features", "sensor", "state")
"""What a policy may have encoders of, in the order in which it builds them."""

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


def stream_validity(observation: Observation, stream: str) -> Tensor:
    """What of a stream is real: (batch, slot) bool of the features, else (batch,) counts."""
    if stream == "features":
        return observation.slot_valid
    return getattr(observation, f"{stream}_valid")


def drop_streams(
    validity: Mapping[str, Tensor],
    rates: Mapping[str, float],
    generator: torch.Generator | None = None,
) -> dict[str, Tensor]:
    """The validity of each stream, 0 for a random share `rates[stream]` of the samples.

    Modality dropout (Neverova et al. 2016, "ModDrop"): so that a policy learns to lean on what
    it has. Streams are dropped independently, but a sample never loses all that it has: one of
    its streams, each as likely, is then kept. With rates p and q of two streams, the first is
    thus missing from p - pq/2 of the samples that have both.
    """
    device = next(iter(validity.values())).device
    present = torch.stack([v.reshape(len(v), -1).gt(0).any(dim=1) for v in validity.values()], 1)
    limits = torch.tensor([rates[name] for name in validity], device=device)
    draw = uniform(present.numel(), device, generator).view(present.shape)
    dropped = draw < limits
    # Below its limit a draw is uniform, so relative to it all streams are alike.
    relative = (draw / limits.clamp(min=torch.finfo(limits.dtype).tiny)).masked_fill(~present, -1.0)
    last = torch.zeros_like(present).scatter(1, relative.argmax(dim=1, keepdim=True), True)
    blind = ~(present & ~dropped).any(dim=1, keepdim=True)
    dropped = dropped & ~(blind & last)
    return {
        name: valid.masked_fill(gone.view(-1, *[1] * (valid.ndim - 1)), 0)
        for (name, valid), gone in zip(validity.items(), dropped.unbind(dim=1), strict=True)
    }
