"""An observation whose features, of some samples or all, a model has yet to compute."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from pipeline.base.errors import ObservationError
from pipeline.policy.observation import STREAMS, Observation
from pipeline.policy.policy import Policy


@runtime_checkable
class LiveObservation(Observation, Protocol):
    """An observation with rows for the vision-language model beside its cached features."""

    rows: Sequence[Any]
    """`pipeline.vlm.preparation.PreparedRow`s, each distinct one once."""
    row_of: Int64[Tensor, " batch"]
    """Index into `rows` of each sample; -1 keeps the sample's cached features."""


@dataclass
class Seen:
    """An observation made by hand; without rows it is a cached one."""

    features: Float[Tensor, "batch slot dim"]
    slot_valid: Bool[Tensor, "batch slot"]
    feature_age: Float[Tensor, " batch"]
    sensor: Float[Tensor, "batch sensor_window channel"]
    sensor_valid: Int[Tensor, " batch"]
    state: Float[Tensor, "batch state_window state_dim"]
    state_valid: Int[Tensor, " batch"]
    rows: Sequence[Any]
    row_of: Int64[Tensor, " batch"]


_STREAM_OF = {name: name for name in STREAMS} | {
    "slot_valid": "features",
    "feature_age": "features",
    "sensor_valid": "sensor",
    "state_valid": "state",
}
_SHARED = tuple(field.name for field in fields(Seen) if field.name not in ("rows", "row_of"))


def with_features(
    observation: LiveObservation,
    features: Float[Tensor, "row slot dim"],
    slot_valid: Bool[Tensor, "row slot"],
) -> Seen:
    """The observation with the features of its rows where a sample has one."""
    given = {name: getattr(observation, name) for name in _SHARED}
    row_of = observation.row_of.to(features.device)
    live, index = row_of >= 0, row_of.clamp(min=0)
    cached = given["features"].to(features.dtype)
    given["features"] = torch.where(live[:, None, None], features[index], cached)
    given["slot_valid"] = torch.where(live[:, None], slot_valid[index], given["slot_valid"])
    return Seen(**given, rows=(), row_of=torch.full_like(row_of, -1))


def observation_of(
    policy: Policy,
    streams: Mapping[str, Any],
    rows: Sequence[Any] = (),
    row_of: Sequence[int] = (),
) -> Seen:
    """The observation of what was given, on the policy's device; what was not is missing.

    `streams` has the fields of `Observation` as tensors or arrays, None where not given. Without
    its `*_valid` a stream is all real, without `feature_age` features are new. A stream without an
    encoder is left out. Raises `ObservationError` where nothing is left to look at, for a `*_valid`
    without its stream, and for a shape that is not the policy's or not the batch's.
    """
    device = next(policy.parameters()).device
    shape, params = policy.shape, policy.params
    given = {
        name: torch.as_tensor(value, device=device)
        for name, value in streams.items()
        if value is not None and _STREAM_OF[name] in policy.encoders
    }
    index = torch.tensor(list(row_of), dtype=torch.int64, device=device)
    first = _first(policy, given, rows)
    # The number of elements and not len, which a scalar lacks; its shape is refused all the same.
    count = given[first].shape[:1].numel() if first in given else len(index)
    _check(policy, given, {"batch": count}, first)
    if len(index):
        _check_shape("images", index, {"batch": count}, first)

    def values(name: str, *size: int) -> Tensor:
        return given.get(name, torch.zeros(count, *size, device=device))

    def valid(name: str, stream: Tensor) -> Tensor:
        real = stream.shape[1] if name in given else 0
        return given.get(f"{name}_valid", torch.full((count,), real, device=device))

    sensor = values("sensor", params.sensor_window, shape.sensor_channels)
    state = values("state", params.state_window, shape.state_dim)
    cached = torch.full((count, shape.slots), "features" in given, device=device)
    return Seen(
        features=values("features", shape.slots, shape.feature_dim),
        slot_valid=given.get("slot_valid", cached).bool(),
        feature_age=values("feature_age"),
        sensor=sensor,
        sensor_valid=valid("sensor", sensor),
        state=state,
        state_valid=valid("state", state),
        rows=rows,
        row_of=index if len(index) else torch.full((count,), -1, device=device),
    )


def target_of(
    policy: Policy, observation: Observation, actions: Any, action_valid: Any
) -> tuple[Float[Tensor, "batch horizon action"], Bool[Tensor, "batch horizon"]]:
    """Physical actions on the observation's device, and which of them are real; None: all.

    Raises `ObservationError` for a shape that is not the policy's or not the observation's.
    """
    device = observation.features.device
    steps = {"batch": len(observation.features), "horizon": policy.params.horizon}
    action = torch.as_tensor(actions, dtype=torch.float32, device=device)
    _check_shape("actions", action, {**steps, "channel": policy.shape.action_dim}, "the streams")
    if action_valid is None:
        action_valid = torch.ones(action.shape[:2], dtype=torch.bool)
    valid = torch.as_tensor(action_valid, device=device)
    _check_shape("action_valid", valid, steps, "the streams")
    return action, valid.bool()


def _check_shape(name: str, value: Tensor, axes: Mapping[str, int | None], batch_of: str) -> None:
    """Raise `ObservationError` where an argument has not these sizes by axis; None is any above 0.

    `batch_of` is the argument that says how large the batch is.
    """
    found = tuple(value.shape)
    fits = len(found) == len(axes) and all(
        have == size or (size is None and have > 0)
        for have, size in zip(found, axes.values(), strict=True)
    )
    if not fits:
        sizes = (f"{axis} {'any' if size is None else size}" for axis, size in axes.items())
        raise ObservationError(
            f"{name}: expected shape ({', '.join(sizes)}), found {found}. The batch is that of "
            f"{batch_of}; all else is what the policy was built for: give that or build another."
        )


def _first(policy: Policy, given: Mapping[str, Tensor], rows: Sequence[Any]) -> str:
    """The argument that says how large the batch is."""
    for name, stream in _STREAM_OF.items():
        if name.endswith("_valid") and name in given and stream not in given:
            raise ObservationError(
                f"{name}: expected {stream} beside it, of which it says what is real"
            )
    for name in STREAMS:
        if name in given:
            return name
    if not rows:
        looked_at = ", ".join(policy.encoders)
        raise ObservationError(
            f"expected images or at least one of {looked_at}, found none of them"
        )
    return "images"


def _check(
    policy: Policy, given: Mapping[str, Tensor], batch: Mapping[str, int], batch_of: str
) -> None:
    shape = policy.shape
    own: Mapping[str, Mapping[str, int | None]] = {
        "features": {"slot": shape.slots, "dim": shape.feature_dim},
        "slot_valid": {"slot": shape.slots},
        # Of any length: it is resampled. The state's tokens have places, as many as configured.
        "sensor": {"window": None, "channel": shape.sensor_channels},
        "state": {"window": policy.params.state_window, "channel": shape.state_dim},
    }
    for name, value in given.items():
        _check_shape(name, value, {**batch, **own.get(name, {})}, batch_of)
