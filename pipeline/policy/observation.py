"""Observations of a policy, and how they are made and checked against its shape."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.base.channels import action_groups
from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ObservationError
from pipeline.base.observation import Observation
from pipeline.base.packing import unpack
from pipeline.policy.ages import even_ages
from pipeline.policy.shape import Axes, PolicyShape

VALIDITY = {"features": "slot_valid", "sensor": "sensor_valid", "state": "state_valid"}
"""The streams that a policy may encode, in the order of its encoders, and the field that says which
of their values are real: (batch, slot) bool for features, else (batch,) counts."""

AGES = {"sensor": "sensor_age", "state": "state_age"}
"""The field with the ages of a stream's readings."""


@dataclass
class LiveObservation(Observation):
    """An observation for which a model has yet to compute the features of some or all samples."""

    rows: Sequence[Any]
    """The distinct inputs of the model (`pipeline.vlm.preparation.PreparedRow`)."""
    row_of: Int[Tensor, " batch"]
    """Index into `rows` of each sample; -1 keeps the sample's cached features."""


def moving_channels(action: Mapping[str, Any]) -> tuple[bool, ...]:
    """Which channels of a store's `streams["action"]` are motions: deltas and velocities.

    A gripper's channel is not: it is a position in every format.
    """
    moves = action["kind"] != "absolute"
    groups = action_groups(action["names"], action["units"])
    return tuple(moves and group != "gripper" for group in groups)


def stream_of(field: str) -> str:
    """The stream of a field of an observation."""
    if field in ("slot_valid", "feature_age", "view_age"):
        return "features"
    return field.removesuffix("_valid").removesuffix("_age")


def build_observation(
    shape: PolicyShape,
    params: TrainHeadParams,
    given: Mapping[str, Tensor],
    device: torch.device,
    rows: Sequence[Any] = (),
    row_of: Sequence[int] = (),
) -> LiveObservation:
    """The observation with the `given` fields; other streams are missing.

    Without its `*_valid`, all of a stream is real; without `*_age`, its readings are spread evenly
    over the seconds of its window. Without `feature_age`, features are new; without `view_age`, all
    views are as old as the features. Raises `ObservationError` for a `*_valid` or an age without
    its stream, and for a shape that is not the policy's or not the batch's.
    """
    for name in given:
        describes = name.endswith("_valid") or name in AGES.values()
        if describes and stream_of(name) not in given:
            raise ObservationError(
                f"{name}: expected {stream_of(name)} beside it, which it describes"
            )
    first = next((name for name in VALIDITY if name in given), "images")
    index = torch.tensor(row_of, dtype=torch.int64, device=device)
    # A scalar has no len; `check_axes` refuses its shape below.
    count = given[first].shape[:1].numel() if first in given else len(index)
    axes = shape.stream_axes()
    lengths = {"sensor": params.sensor_window, "state": params.state_window}
    for stream in lengths & given.keys():
        if given[stream].ndim == 3:
            lengths[stream] = given[stream].shape[1]
            axes[AGES[stream]] = {"window": lengths[stream]}
    for name, value in given.items():
        check_axes(name, value, {"batch": count, **axes[name]}, first)
    if len(index):
        check_axes("images", index, {"batch": count}, first)
    else:
        index = torch.full((count,), -1, device=device)
    fields = {
        name: torch.zeros(
            count,
            *(lengths[stream_of(name)] if n is None else n for n in a.values()),
            device=device,
        )
        for name, a in axes.items()
    }
    spans = {"sensor": params.sensor_window_s, "state": params.state_window_s}
    for stream, length in lengths.items():
        fields[AGES[stream]] += even_ages(length, spans[stream] or 1.0, fields[stream])
    if "feature_age" in given:
        fields["view_age"] += given["feature_age"][:, None]
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
    """The observation with its rows' features in the samples that have a row."""
    given = {name: getattr(observation, name) for name in Observation.__dataclass_fields__}
    row_of = observation.row_of.to(features.device)
    live, index = row_of >= 0, row_of.clamp(min=0)
    cached = unpack(given["features"]).to(features.dtype)
    given["features"] = torch.where(live[:, None, None], features[index], cached)
    given["slot_valid"] = torch.where(live[:, None], slot_valid[index], given["slot_valid"])
    return Observation(**given)


def check_axes(name: str, value: Tensor, axes: Axes, batch_of: str) -> None:
    """Raise `ObservationError` where an argument lacks these axes.

    `batch_of` is the argument that determines the size of the batch.
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
