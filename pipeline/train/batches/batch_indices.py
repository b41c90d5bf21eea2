"""What a batch is to be made of, and who hands batches out."""

from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import TrainHeadParams
from pipeline.store import Batch

Ticks = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class BatchIndices:
    """What one batch is made of."""

    ticks: Ticks
    """(batch,) store-global."""
    variants: NDArray[np.int64] | None = None
    """(batch,) which stored variant of its VL row each tick sees; None: all 0, the plain frames."""


def draws(ticks: Ticks, batch_size: int) -> list[BatchIndices]:
    """The ticks in their order, `batch_size` at a time."""
    return [
        BatchIndices(part) for part in np.split(ticks, range(batch_size, len(ticks), batch_size))
    ]


@dataclass(frozen=True)
class Lags:
    """How late each stream is: `features` in whole VL rows, the others in seconds."""

    features: int = 0
    sensor_s: float = 0.0
    state_s: float = 0.0


NO_LAGS = Lags()


@dataclass(frozen=True)
class Windows:
    """How much of each stream a sample sees, in ticks (`horizon`) and readings."""

    horizon: int
    sensor_window: int
    state_window: int

    @classmethod
    def of(cls, params: TrainHeadParams) -> Self:
        """What this policy needs; of a stream whose encoder is off, a single reading."""
        return cls(
            params.horizon,
            params.sensor_window if params.sensor_enabled else 1,
            params.state_window if params.robot_state_enabled else 1,
        )


class Feed(Protocol):
    """Batches in the order of a plan: what a training and an evaluation iterate over."""

    waited_s: float
    """Time that the consumer has spent waiting for data."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
        /,
    ) -> None: ...

    def __iter__(self) -> Iterator[tuple[BatchIndices, Batch]]: ...
