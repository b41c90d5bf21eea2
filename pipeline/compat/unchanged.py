"""Statistics that change nothing, for a policy without a training set."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.policy.observation import PolicyShape


@dataclass(frozen=True, eq=False)
class _Unit:
    """Mean 0 and scale 1."""

    shape: tuple[int, ...]

    @property
    def mean(self) -> NDArray[np.float64]:
        return np.zeros(self.shape)

    @property
    def scale(self) -> NDArray[np.float64]:
        return np.ones(self.shape)


class Unchanged:
    """`StreamStatistics` of a shape under which every stream stays as it is."""

    def __init__(self, shape: PolicyShape) -> None:
        self.action = _Unit((shape.action_dim,))
        self.features = _Unit((shape.slots, shape.feature_dim))
        self.sensor = _Unit((shape.sensor_channels,))
        self.state = _Unit((shape.state_dim,))
