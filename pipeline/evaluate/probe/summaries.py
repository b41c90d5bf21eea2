"""What the other streams know at a tick: a few numbers for each causal window."""

from collections.abc import Iterator, Sequence
from tempfile import TemporaryFile

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from pipeline.base.errors import NumericsError
from pipeline.evaluate.probe.projection import GroupedProjection
from pipeline.store import Batch, FeatureStore, place
from pipeline.train.batches import Prefetch, Windows, cut_batches

GROUP_WIDTH = 64
"""Directions at most of each summary of channels that share a unit."""
_SAMPLE_TICKS = 2048
"""That the directions are fitted on."""
_BATCH_TICKS = 64


def summarize(
    store: FeatureStore,
    ticks: NDArray[np.int64],
    fold: NDArray[np.int64],
    sensor_window: int,
    state_window: int,
) -> NDArray[np.float32]:
    """The last, the mean and the spread of every channel over the window before each tick.

    (tick, column), in a file without a name that ends with the process; no column where the store
    has neither stream.

    Channels of one unit that are more than `GROUP_WIDTH`, as those of an A-scan, are projected on
    that many main directions of each summary, so a force beside them is not lost. The windows are
    those of `FeatureStore.gather`, so nothing is later than its tick; a tick without a reading has
    the mean of those with one, and a column that says so. `fold` (tick,) is the fold that each is
    held out in, for the limits of `Projection`. Raises `NumericsError` on NaN or inf.
    """
    windows = Windows(1, sensor_window, state_window)
    step = -(-len(ticks) // _SAMPLE_TICKS)
    groups = {stream: _groups(store, stream) for stream in ("sensor", "state")}
    projections = _fitted(store, ticks[::step], fold[::step], windows, groups)
    width = sum(one.width + 1 for one in projections.values())
    if not width:
        return np.empty((len(ticks), 0), np.float32)
    # Beside the few sums, this is the only thing that grows with the ticks: it may leave memory.
    with TemporaryFile() as file:
        values = np.memmap(file, np.float32, "w+", shape=(len(ticks), width))
    done = 0
    for batch in _batches(store, ticks, windows, "state + sensor"):
        parts: list[Tensor] = []
        for stream, project in projections.items():
            summary, known = _summary(batch, stream)
            parts += [torch.where(known, project(summary), 0.0), known.double()]
        values[done : done + len(batch)] = torch.cat(parts, dim=1).float().numpy()
        done += len(batch)
    return values


def _fitted(
    store: FeatureStore,
    sample: NDArray[np.int64],
    fold: NDArray[np.int64],
    windows: Windows,
    groups: dict[str, list[Tensor]],
) -> dict[str, GroupedProjection]:
    """Of each stream that the store has, from the ticks of the sample that have readings."""
    there = [stream for stream in groups if groups[stream]]
    if not there:
        return {}
    seen: dict[str, list[tuple[Tensor, Tensor]]] = {stream: [] for stream in there}
    for batch in _batches(store, sample, windows, "directions of state + sensor"):
        for stream in there:
            summary, known = _summary(batch, stream)
            seen[stream].append((summary, known[:, 0]))
    fitted = {}
    for stream, several in seen.items():
        known = torch.cat([known for _, known in several])
        if known.any():
            rows = torch.cat([summary for summary, _ in several])[known]
            at = fold[known.numpy()]
            fitted[stream] = GroupedProjection.fit(rows, at, groups[stream], GROUP_WIDTH)
    return fitted


def _groups(store: FeatureStore, stream: str) -> list[Tensor]:
    """Channels by unit, once for each of the three summaries; none of a stream without channels."""
    units: Sequence[str] = store.streams[stream]["units"]
    by_unit: dict[str, list[int]] = {}
    for channel, unit in enumerate(units):
        by_unit.setdefault(unit, []).append(channel)
    return [
        torch.tensor(channels) + summary * len(units)
        for summary in range(3)
        for channels in by_unit.values()
    ]


def _batches(
    store: FeatureStore, ticks: NDArray[np.int64], windows: Windows, said: str
) -> Iterator[Batch]:
    """The windows of the ticks, in order, checked."""
    with (
        tqdm(total=len(ticks), desc=said, unit="tick", leave=False, disable=None) as bar,
        Prefetch(store, cut_batches(ticks, _BATCH_TICKS), windows, torch.device("cpu")) as batches,
    ):
        for draw, batch in batches:
            for stream in ("sensor", "state"):
                _check(store, stream, batch, draw.ticks)
            yield batch
            bar.update(len(batch))


def _check(store: FeatureStore, stream: str, batch: Batch, ticks: NDArray[np.int64]) -> None:
    window: Tensor = getattr(batch, stream)
    # A sum over everything is finite where all of it is, and costs a tenth of looking at each.
    if torch.isfinite(window.sum(dtype=torch.float64)):
        return
    index, reading, channel = (int(one) for one in torch.nonzero(~torch.isfinite(window))[0])
    ends = store.array(f"tick/{stream}_end")
    row = int(ends[ticks[index]]) - window.shape[1] + reading
    raise NumericsError(
        f"{store.path}: expected finite numbers, found {float(window[index, reading, channel])} at "
        f"{place(store, stream, row)}, channel {store.streams[stream]['names'][channel]!r}. Mend "
        "or leave out the recording and run stages.extract again."
    )


def _summary(batch: Batch, stream: str) -> tuple[Tensor, Tensor]:
    """(batch, 3 x channel) in float64, and (batch, 1) whether there was a reading."""
    window: Tensor = getattr(batch, stream)
    count: Tensor = getattr(batch, f"{stream}_valid")
    last = window[:, -1].float()
    # Distances to the last reading, which lose less than squares of the readings themselves.
    apart = window.float() - last[:, None]
    before = torch.arange(window.shape[1]) < (window.shape[1] - count)[:, None]
    if before.any():
        apart.masked_fill_(before[:, :, None], 0.0)
    rows = count.clamp(min=1)[:, None]
    shift = apart.sum(dim=1).double() / rows
    square = apart.square_().sum(dim=1).double() / rows
    spread = (square - shift * shift).clamp(min=0).sqrt()
    return torch.cat([last.double(), last + shift, spread], dim=1), count[:, None] > 0
