"""The batch that `gather` fills."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.base.observation import Observation


@dataclass
class Batch(Observation):
    """What a policy sees at `batch` ticks, and the actions that it should answer.

    A stream that the store lacks has width 0. Features and sensor keep their stored dtype.
    """

    action: Float[Tensor, "batch horizon action_dim"]
    action_valid: Bool[Tensor, "batch horizon"]

    def __len__(self) -> int:
        return len(self.features)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """(batch, horizon, sensor_window, state_window)."""
        return len(self), self.action.shape[1], self.sensor.shape[1], self.state.shape[1]

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Self:
        """The batch on another device; fields that are not tensors stay as they are."""
        return self._mapped(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin(self) -> Self:
        """The batch in page-locked memory, from which copies to a GPU are asynchronous.

        Tensors on a device stay there.
        """
        return self._mapped(lambda tensor: tensor.pin_memory() if tensor.is_cpu else tensor)

    def touch(self) -> Self:
        """Zero the batch in place, so that every page of its memory exists before it is filled."""
        return self._mapped(lambda tensor: tensor.zero_())

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Self:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, **{name: change(value) for name, value in tensors.items()})
