"""Statistics applied to tensors."""

from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn


@runtime_checkable
class Statistics(Protocol):
    """Mean and scale of a stream, each of the shape of its channels."""

    @property
    def mean(self) -> NDArray[np.float64]: ...

    @property
    def scale(self) -> NDArray[np.float64]: ...


@runtime_checkable
class StreamStatistics(Protocol):
    """Statistics by stream, None where a stream is absent; see `pipeline.policy.normalization`."""

    @property
    def action(self) -> Statistics: ...

    @property
    def features(self) -> Statistics | None: ...

    @property
    def sensor(self) -> Statistics | None: ...

    @property
    def state(self) -> Statistics | None: ...


class Normalizer(nn.Module):
    """Physical units to zero mean and unit variance per channel, and back, in float32.

    The statistics are buffers that move with the module but stay out of its state dict: they
    travel in the checkpoint's JSON.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, statistics: Statistics) -> None:
        super().__init__()
        for name, value in (("mean", statistics.mean), ("scale", statistics.scale)):
            self.register_buffer(name, torch.tensor(value, dtype=torch.float32), persistent=False)

    def normalize(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The normalised values; trailing axes are the statistics' channels, any float dtype."""
        return (values.to(self.mean.dtype) - self.mean).div_(self.scale)

    def invert(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Physical units from normalised values, any float dtype."""
        return values.to(self.mean.dtype) * self.scale + self.mean
