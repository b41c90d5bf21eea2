"""The input of a policy, gathered from a store or measured by a robot."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor


@dataclass
class Observation:
    """The input of a policy at `batch` ticks, in physical units.

    Streams have their stored dtype. Windows are right-aligned: they end at their tick and are zero
    on the left where the episode had not begun; `*_valid` counts the real readings. An absent
    stream has width 0.
    """

    features: Shaped[Tensor, "batch slot _"]
    """Numbers, or the codes of int8 or float8 (uint8) for `pipeline.base.packing.unpack`."""
    slot_valid: Bool[Tensor, "batch slot"]
    feature_age: Float[Tensor, " batch"]
    """Seconds since the newest frame of the features."""
    view_age: Float[Tensor, "batch view"]
    """Seconds since each view's frame in the features; NaN for a missing view."""
    sensor: Float[Tensor, "batch sensor_window channel"]
    sensor_valid: Int[Tensor, " batch"]
    sensor_age: Float[Tensor, "batch sensor_window"]
    """Seconds since each reading; 0 where it is not real."""
    state: Float[Tensor, "batch state_window state_dim"]
    state_valid: Int[Tensor, " batch"]
    state_age: Float[Tensor, "batch state_window"]
    """Like `sensor_age`."""
