"""Per-channel mean and standard deviation: fitted in one streaming pass, kept exactly in JSON.

Numpy only; `pipeline.policy.policy.Normalizer` applies them to tensors.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import CheckpointMismatch, NumericsError
from pipeline.base.finite import first_non_finite

Block = NDArray[Any] | tuple[NDArray[Any], NDArray[np.bool_]]
"""Rows of values, or such rows and which of their values are valid."""

Reading = Block | Callable[[], Block]
"""A block, or what reads one: on one of several threads, and again where an error is named."""

_PIECE_VALUES = 4_194_304
"""Values converted to float64 at a time: 32 MB, whatever the size of the blocks."""

_RELATIVE_FLOOR = 4 * float(np.finfo(np.float32).eps)
"""A spread below a few float32 steps of the mean is rounding, not signal."""


@dataclass(frozen=True, eq=False)
class ChannelStatistics:
    """Mean and population standard deviation of each channel over `count` rows.

    `mean` and `std` are float64 of one shape: (channel,), or (slot, dim) for features.
    """

    mean: NDArray[np.float64]
    std: NDArray[np.float64]
    count: int

    @property
    def scale(self) -> NDArray[np.float64]:
        """What to divide by: `std`, or 1 where the channel does not vary.

        So a constant channel comes out as 0 and inverts exactly.
        """
        floor = np.maximum(_RELATIVE_FLOOR * np.abs(self.mean), float(np.finfo(np.float32).tiny))
        return np.where(self.std > floor, self.std, 1.0)

    def document(self) -> dict[str, Any]:
        """The statistics as JSON values; Python writes the shortest digits that read back equal."""
        return {"mean": self.mean.tolist(), "std": self.std.tolist(), "count": self.count}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "ChannelStatistics":
        """The statistics of a `document`, bit for bit. Raises `CheckpointMismatch`."""
        try:
            mean = np.asarray(document["mean"], np.float64)
            std = np.asarray(document["std"], np.float64)
            count = int(document["count"])
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointMismatch(
                f"normalisation: expected numbers under mean, std and count, found {error!r}"
            ) from None
        if mean.shape != std.shape:
            raise CheckpointMismatch(
                f"normalisation: mean has shape {mean.shape}, std {std.shape}; they must agree"
            )
        return cls(mean, std, count)


@dataclass(frozen=True, eq=False)
class Normalization:
    """The statistics of every stream a policy sees; None for a stream it does not have."""

    action: ChannelStatistics
    features: ChannelStatistics | None = None
    sensor: ChannelStatistics | None = None
    state: ChannelStatistics | None = None

    def document(self) -> dict[str, Any]:
        """All statistics as JSON values."""
        return {name: fitted and fitted.document() for name, fitted in vars(self).items()}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "Normalization":
        """The normalisation of a `document`, bit for bit. Raises `CheckpointMismatch`."""
        if document.get("action") is None:
            raise CheckpointMismatch("normalisation: expected statistics of `action`, found none")
        streams = {
            name: ChannelStatistics.from_document(document[name])
            for name in cls.__dataclass_fields__
            if document.get(name) is not None
        }
        return cls(**streams)


def fit_channels(
    blocks: Iterable[Reading], what: str, names: Sequence[str] | None = None, threads: int = 1
) -> ChannelStatistics:
    """Statistics over all rows of `blocks`, each (row, channel…) of floating point, in one pass.

    A block may be a pair (values, valid): `valid` is bool over the leading axes of `values`, such
    as (row, slot) for features (row, slot, dim), and what is not valid is neither checked nor
    counted. Moments are merged in float64 after Chan, Golub and LeVeque (1983), eq. 2.1, in the
    order of the blocks: the same bits, however many `threads` read them.
    Raises `NumericsError`, naming `what`, channel and row, on NaN, inf, or where there is no row.
    """
    moments: _Moments | None = None
    rows = 0
    for block, measured in _measured_in_order(blocks, what, threads):
        for index, (piece, count) in enumerate(measured):
            if not np.isfinite(piece.squares).all():
                values, valid = next(islice(_pieces(block), index, None))
                _refuse(values, valid, what, names, rows)
            moments = piece if moments is None else _merge(moments, piece)
            rows += count
    if moments is None:
        raise NumericsError(f"{what}: no rows to fit the normalisation on; check the split")
    variance = moments.squares / np.maximum(moments.count, 1)
    return ChannelStatistics(moments.mean, np.sqrt(variance), rows)


@dataclass(frozen=True)
class _Moments:
    """`count` broadcasts to the channels; `squares` is the sum of squared distances to `mean`."""

    count: NDArray[np.float64]
    mean: NDArray[np.float64]
    squares: NDArray[np.float64]


def _measured_in_order(
    blocks: Iterable[Reading], what: str, threads: int
) -> Iterator[tuple[Reading, list[tuple[_Moments, int]]]]:
    """Each block, and of each piece of it the moments and how many rows it has.

    A few blocks at a time, so that memory does not grow with their number.
    """
    waiting = iter(blocks)
    with ThreadPoolExecutor(threads) as pool:
        while some := list(islice(waiting, 2 * threads)):
            yield from zip(some, pool.map(partial(_measured, what=what), some), strict=True)


def _measured(block: Reading, what: str) -> list[tuple[_Moments, int]]:
    return [(_moments(*piece, what), len(piece[0])) for piece in _pieces(block)]


def _pieces(block: Reading) -> Iterator[tuple[NDArray[Any], NDArray[np.bool_] | None]]:
    read = block() if callable(block) else block
    values, valid = read if isinstance(read, tuple) else (read, None)
    channels = int(np.prod(values.shape[1:]))
    rows = max(1, _PIECE_VALUES // max(1, channels))
    for start in range(0, len(values), rows):
        part = slice(start, start + rows)
        yield values[part], None if valid is None else valid[part]


def _moments(values: NDArray[Any], valid: NDArray[np.bool_] | None, what: str) -> _Moments:
    if not np.issubdtype(values.dtype, np.floating):
        raise TypeError(f"{what}: expected floating point, found {values.dtype}")
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
    return _Moments(np.asarray(count), mean, squares)


def _merge(left: _Moments, right: _Moments) -> _Moments:
    count = left.count + right.count
    delta = right.mean - left.mean
    share = right.count / np.maximum(count, 1)
    return _Moments(
        count,
        left.mean + delta * share,
        left.squares + right.squares + delta * delta * left.count * share,
    )


def _refuse(
    values: NDArray[Any],
    valid: NDArray[np.bool_] | None,
    what: str,
    names: Sequence[str] | None,
    first_row: int,
) -> None:
    at = first_non_finite(values, valid)
    if at is None:
        raise NumericsError(
            f"{what}: values near row {first_row} are so large that their variance overflows"
        )
    row, *channel = at
    place = ", ".join(str(i) for i in channel)
    if names is not None and len(channel) == 1:
        place = repr(names[channel[0]])
    raise NumericsError(
        f"{what}: expected finite numbers, found {values[at]} in row "
        f"{first_row + row}, channel {place}. Mend the recording and run stages.extract again."
    )
