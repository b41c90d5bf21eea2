"""Mean and standard deviation per channel: fitted in one streaming pass, kept exactly in JSON.

Numpy only; `pipeline.policy.policy.Normalizer` applies them to tensors.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, GetPydanticSchema

from pipeline.base.arrays import first_non_finite
from pipeline.base.errors import NumericsError

Block = NDArray[Any] | tuple[NDArray[Any], NDArray[np.bool_]]
"""Rows of values, or rows of values and which of them are valid."""

Reading = Block | Callable[[], Block]
"""A block, or a function that reads one, on one of several threads."""

_PIECE_VALUES = 4_194_304
"""Values converted to float64 at a time: 32 MB, whatever the size of the blocks."""

_LEAST_SPREAD = 0.05
"""A share of the usual spread of similar inputs: what rested in training may move later."""

_TINY = float(np.finfo(np.float32).tiny)
_RELATIVE_FLOOR = 4 * float(np.finfo(np.float32).eps)
"""A spread below a few float32 steps of the mean is rounding, not signal."""

_MOST = 1e30
"""The largest number in a document: products and quotients stay finite in float32."""


def _read_from(least: float) -> GetPydanticSchema:
    """The schema by which a document's numbers, of one axis or of two, become an array."""
    row = tuple[Annotated[float, Field(ge=least, le=_MOST)], ...]
    numbers = Annotated[row | tuple[row, ...], AfterValidator(_array)]
    return GetPydanticSchema(lambda source, handler: handler(numbers))


def _array(numbers: Sequence[float] | Sequence[Sequence[float]]) -> NDArray[np.float64]:
    try:
        return np.array(numbers, np.float64)
    except ValueError:
        raise ValueError("expected rows of one length") from None


@dataclass(frozen=True, eq=False)
class ChannelStatistics:
    """Mean and population standard deviation of each channel over `count` rows.

    `mean` and `std` are float64 of one shape: (channel,), or (slot, dim) for features.
    """

    mean: Annotated[NDArray[np.float64], _read_from(-_MOST)]
    std: Annotated[NDArray[np.float64], _read_from(0.0)]
    count: Annotated[int, Field(ge=0)]

    @property
    def scale(self) -> NDArray[np.float64]:
        """The divisor: `std`, or 1 where the channel does not vary.

        So a constant channel becomes 0 and inverts exactly.
        """
        return np.where(self._varies, self.std, 1.0)

    @property
    def spread(self) -> NDArray[np.float64]:
        """`std`, or 0 where the channel does not vary."""
        return np.where(self._varies, self.std, 0.0)

    @property
    def _varies(self) -> NDArray[np.bool_]:
        return self.std > np.maximum(_RELATIVE_FLOOR * np.abs(self.mean), _TINY)

    def floored(self, usual: NDArray[np.float64]) -> "ChannelStatistics":
        """These statistics with every spread raised to 5 % of the `usual` one, at least.

        `usual` is the spread of similar channels; it broadcasts, 0 where there are none.
        """
        return replace(self, std=np.maximum(self.std, _LEAST_SPREAD * usual))

    def at(self, index: Sequence[int]) -> "ChannelStatistics":
        """The statistics of slots that share them: `index` (slot,) of the statistics of each."""
        return replace(self, mean=self.mean[[*index]], std=self.std[[*index]])

    def shared(self, index: Sequence[int]) -> "ChannelStatistics":
        """The statistics of slots (slot, dim) together where their `index` (slot,) is equal.

        Slots that share them are valid in the same rows, so each counts as much.
        """
        groups = np.array(index) == np.arange(max(index) + 1)[:, None]
        share = groups / groups.sum(axis=1, keepdims=True)
        mean = share @ self.mean
        variance = share @ (self.std**2 + (self.mean - mean[[*index]]) ** 2)
        return replace(self, mean=mean, std=np.sqrt(variance))

    def document(self) -> dict[str, Any]:
        """The statistics as JSON values; Python writes the shortest digits that read equal."""
        return {"mean": self.mean.tolist(), "std": self.std.tolist(), "count": self.count}


@dataclass(frozen=True, eq=False)
class Normalization:
    """The statistics of every stream that a policy sees; None for a stream that it lacks."""

    action: ChannelStatistics
    features: ChannelStatistics | None = None
    sensor: ChannelStatistics | None = None
    state: ChannelStatistics | None = None
    relative: ChannelStatistics | None = None
    """Of chunks with channels relative to the state; None where the policy learns none."""

    def document(self) -> dict[str, Any]:
        """All statistics as JSON values."""
        return {name: fitted and fitted.document() for name, fitted in vars(self).items()}


def fit_channels(blocks: Iterable[Reading], what: str, threads: int = 1) -> ChannelStatistics:
    """Statistics over all rows of `blocks`, each (row, channel…) of floating point, in one pass.

    A block may be a pair (values, valid): `valid` is bool over the leading axes of `values`, such
    as (row, slot) for features (row, slot, dim); values that are not valid are neither checked nor
    counted. Moments are merged in float64 after Chan, Golub and LeVeque (1983), eq. 2.1, in the
    order of the blocks, so the bits do not depend on the number of `threads` that read them. A few
    blocks are read at a time, so memory does not grow with their number. Raises `NumericsError`,
    naming `what` and the channel, on NaN or inf, or where there is no row.
    """
    waiting, total = iter(blocks), None
    with ThreadPoolExecutor(threads) as pool:
        while some := list(islice(waiting, 2 * threads)):
            for moments in chain.from_iterable(pool.map(partial(_measure, what=what), some)):
                total = moments if total is None else _merge(total, moments)
    if total is None:
        raise NumericsError(f"{what}: no rows to fit the normalisation on; check the split")
    variance = total.squares / np.maximum(total.count, 1)
    return ChannelStatistics(total.mean, np.sqrt(variance), total.rows)


@dataclass(frozen=True)
class _Moments:
    """`count` broadcasts to the channels; `squares` is the sum of squared distances to `mean`."""

    rows: int
    count: NDArray[np.float64]
    mean: NDArray[np.float64]
    squares: NDArray[np.float64]


def _measure(block: Reading, what: str) -> list[_Moments]:
    """The moments of a block, a piece at a time."""
    read = block() if callable(block) else block
    values, valid = read if isinstance(read, tuple) else (read, None)
    if not np.issubdtype(values.dtype, np.floating):
        raise TypeError(f"{what}: expected floating point, found {values.dtype}")
    rows = max(1, _PIECE_VALUES // max(1, int(np.prod(values.shape[1:]))))
    pieces = (slice(start, start + rows) for start in range(0, len(values), rows))
    return [_moments(values[at], None if valid is None else valid[at], what) for at in pieces]


def _moments(values: NDArray[Any], valid: NDArray[np.bool_] | None, what: str) -> _Moments:
    with np.errstate(invalid="ignore", over="ignore"):
        piece = values.astype(np.float64)
        if valid is None:
            count = np.float64(len(piece))
            mean = piece.mean(axis=0)
            piece -= mean
        else:
            weight = valid.reshape(valid.shape + (1,) * (piece.ndim - valid.ndim))
            count = weight.sum(axis=0, dtype=np.float64)
            piece = np.where(weight, piece, 0.0)
            mean = piece.sum(axis=0) / np.maximum(count, 1)
            piece = np.where(weight, piece - mean, 0.0)
        squares = np.einsum("r...,r...->...", piece, piece)
    if not np.isfinite(squares).all():
        at = first_non_finite(values, valid)
        actual = f"{values[at]} in channel {list(at[1:])}" if at else "values too large to square"
        raise NumericsError(
            f"{what}: expected finite numbers, found {actual}. Mend the recording and run "
            "stages.extract again."
        )
    return _Moments(len(values), np.asarray(count), mean, squares)


def _merge(left: _Moments, right: _Moments) -> _Moments:
    count = np.asarray(left.count + right.count)
    delta = right.mean - left.mean
    share = right.count / np.maximum(count, 1)
    return _Moments(
        left.rows + right.rows,
        count,
        left.mean + delta * share,
        left.squares + right.squares + delta * delta * left.count * share,
    )
