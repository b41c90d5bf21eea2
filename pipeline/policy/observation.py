"""What a policy is built for, and observations made by hand that are checked against it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ObservationError
from pipeline.base.observation import Observation

VALIDITY = {"features": "slot_valid", "sensor": "sensor_valid", "state": "state_valid"}
"""What a policy may have encoders of, in the order in which it builds them, and the field that says
what of it is real: (batch, slot) bool of the features, else (batch,) counts."""

_GROUP_BY_UNIT = dict.fromkeys(("m", "cm", "mm"), "translation") | {
    "deg": "rotation",
    "rad": "rotation",
}

Axes = Mapping[str, int | None]
"""Names and sizes of a tensor's axes; None is any size above 0."""


@dataclass
class LiveObservation(Observation):
    """An observation whose features, of some samples or all, a model has yet to compute."""

    rows: Sequence[Any]
    """What the model takes (`pipeline.vlm.preparation.PreparedRow`), each distinct one once."""
    row_of: Int[Tensor, " batch"]
    """Index into `rows` of each sample; -1 keeps the sample's cached features."""


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

    @property
    def channels(self) -> dict[str, tuple[int, ...]]:
        """The shape of each stream's statistics, and of the action's."""
        return {
            "features": (self.slots, self.feature_dim),
            "sensor": (self.sensor_channels,),
            "state": (self.state_dim,),
            "action": (self.action_dim,),
        }

    def stream_axes(self, params: TrainHeadParams) -> dict[str, Axes]:
        """The axes behind the batch of each field of an `Observation` of this shape."""
        return {
            "features": {"slot": self.slots, "dim": self.feature_dim},
            "slot_valid": {"slot": self.slots},
            "feature_age": {},
            # Of any length: it is resampled. The state's tokens have places, as many as configured.
            "sensor": {"window": None, "channel": self.sensor_channels},
            "sensor_valid": {},
            "state": {"window": params.state_window, "channel": self.state_dim},
            "state_valid": {},
        }


def action_groups(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """The loss group of each action channel, by its name (gripper) and then by its unit.

    Lengths are translation and angles rotation; velocities and unnamed quantities are other.
    """
    return tuple(
        "gripper" if "gripper" in name.lower() else _GROUP_BY_UNIT.get(unit.lower(), "other")
        for name, unit in zip(names, units, strict=True)
    )


def stream_of(field: str) -> str:
    """The stream that a field of an observation is about."""
    return "features" if field in ("slot_valid", "feature_age") else field.removesuffix("_valid")


def build_observation(
    shape: PolicyShape,
    params: TrainHeadParams,
    given: Mapping[str, Tensor],
    device: torch.device,
    rows: Sequence[Any] = (),
    row_of: Sequence[int] = (),
) -> LiveObservation:
    """The observation of the fields that are given; what is not given is missing.

    Without its `*_valid` a stream is all real, without `feature_age` features are new. Raises
    `ObservationError` for a `*_valid` without its stream, and for a shape that is not the policy's
    or not the batch's.
    """
    for name in given:
        if name.endswith("_valid") and stream_of(name) not in given:
            raise ObservationError(
                f"{name}: expected {stream_of(name)} beside it, of which it says what is real"
            )
    first = next((name for name in VALIDITY if name in given), "images")
    index = torch.tensor(row_of, dtype=torch.int64, device=device)
    # The number of elements and not len, which a scalar lacks; its shape is refused all the same.
    count = given[first].shape[:1].numel() if first in given else len(index)
    axes = shape.stream_axes(params)
    for name, value in given.items():
        check_axes(name, value, {"batch": count, **axes[name]}, first)
    if len(index):
        check_axes("images", index, {"batch": count}, first)
    else:
        index = torch.full((count,), -1, device=device)
    window = params.sensor_window
    fields = {
        name: torch.zeros(count, *(window if n is None else n for n in a.values()), device=device)
        for name, a in axes.items()
    }
    for stream, valid in VALIDITY.items():
        real = given[stream].shape[1] if stream in given else 0
        fields[valid] = torch.full_like(fields[valid], real, dtype=torch.int64)
    fields |= given
    fields["slot_valid"] = fields["slot_valid"].bool()
    return LiveObservation(**fields, rows=rows, row_of=index)


def with_features(
    observation: LiveObservation,
    features: Float[Tensor, "row slot dim"],
    slot_valid: Bool[Tensor, "row slot"],
) -> Observation:
    """The observation with the features of its rows where a sample has one."""
    given = {name: getattr(observation, name) for name in Observation.__dataclass_fields__}
    row_of = observation.row_of.to(features.device)
    live, index = row_of >= 0, row_of.clamp(min=0)
    cached = given["features"].to(features.dtype)
    given["features"] = torch.where(live[:, None, None], features[index], cached)
    given["slot_valid"] = torch.where(live[:, None], slot_valid[index], given["slot_valid"])
    return Observation(**given)


def check_axes(name: str, value: Tensor, axes: Axes, batch_of: str) -> None:
    """Raise `ObservationError` where an argument has not these axes.

    `batch_of` is the argument that says how large the batch is.
    """
    actual = tuple(value.shape)
    fits = len(actual) == len(axes) and all(
        have == size or (size is None and have > 0)
        for have, size in zip(actual, axes.values(), strict=True)
    )
    if not fits:
        sizes = (f"{axis} {'any' if size is None else size}" for axis, size in axes.items())
        raise ObservationError(
            f"{name}: expected shape ({', '.join(sizes)}), found {actual}. The batch is that of "
            f"{batch_of}; all else is what the policy was built for: give that or build another."
        )
