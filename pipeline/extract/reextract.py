"""Compute stored rows again with today's software and hardware, and compare."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import StoreMismatch
from pipeline.data import Recording
from pipeline.data.row_range import RowFrames
from pipeline.extract.encoder import Encoder
from pipeline.extract.rows import RANGE_ROWS, ReadyRow, RowPreparation, in_background
from pipeline.extract.survey import Survey, survey
from pipeline.store import FEATURES, FeatureStore
from pipeline.store.integrity.findings import capped
from pipeline.store.reader import Episode
from pipeline.vlm.feature_spec import differences
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM

TOLERANCES = {"float32": 1e-3, "float16": 5e-2, "bfloat16": 3e-1}
"""Largest deviation of a number, relative to the root mean square of its slot, by the coarser of
compute and storage dtype.

Measured with the demo checkpoint on a CPU, against batches of 8 on one thread: batches of 1 and 3,
two threads and eager attention move a number of 16 rows x 49 slots x 128 by at most 7e-6 in
float32, 0.012 in float16 and 0.070 in bfloat16 (two of its steps after four layers). Deeper models
gather more, so a few times that is allowed, and in float32, where nothing is lost by it, a hundred
times, for GPUs sum in other orders. What is wrong in earnest is far beyond: another frame, prompt
or weight moves numbers by about their own size.
"""


@dataclass(frozen=True)
class Deviation:
    """How far one row of today is from the stored one."""

    row: int
    absolute: float
    relative: float
    """To the root mean square of the stored slot; the largest of all variants and slots."""
    slot: int
    """In which the relative deviation is largest, counted over variants and slots."""
    same_pixels: bool
    """Whether the key is that of the store: the frames decode to the same pixels."""
    where: str
    """Recording and row."""


@dataclass(frozen=True)
class Reextraction:
    """What came of it."""

    deviations: tuple[Deviation, ...]
    """Of each row, the largest relative deviation first."""
    tolerance: float
    unchecked: tuple[str, ...]
    """Ids of episodes whose recordings are not there as they were."""
    environment: tuple[str, ...]
    """Where software or hardware of today is not that of the rows."""

    @property
    def beyond(self) -> list[Deviation]:
        """Rows that deviate more than is tolerated; a NaN always does."""
        return [one for one in self.deviations if not one.relative <= self.tolerance]

    def lines(self) -> list[str]:
        """For people."""
        if not self.deviations:
            return ["no row can be computed again", *self._unchecked()]
        worst = self.deviations[0]
        other = [one for one in self.deviations if not one.same_pixels]
        return [
            f"computed {len(self.deviations)} rows again; the largest deviation is "
            f"{worst.relative:.2e} of its slot's root mean square "
            f"(absolute {max(one.absolute for one in self.deviations):.2e}), {self.tolerance:.0e} "
            f"is tolerated: {worst.where}, slot {worst.slot}",
            *capped([f"other pixels than the store's: {one.where}" for one in other], "rows"),
            *(["the decoder of today gives other pixels than that of the store"] if other else []),
            *(f"environment, {line}" for line in self.environment),
            *self._unchecked(),
        ]

    def refusals(self) -> list[str]:
        """For people: the rows beyond the tolerance."""
        said = (
            f"{one.where}: slot {one.slot} deviates {one.relative:.2e} of its root mean square, "
            f"{one.absolute:.2e} absolute"
            + ("" if one.same_pixels else "; its frames decode to other pixels")
            for one in self.beyond
        )
        return capped(list(said), "rows beyond the tolerance")

    def _unchecked(self) -> list[str]:
        said = [
            f"cannot be checked, its recording changed or is gone: {one}" for one in self.unchecked
        ]
        return capped(said, "episodes")


def reextract(path: Path, params: Params, say: Callable[[str], None]) -> Reextraction:
    """Compute `verify.reextract` random rows of a store again, each with all its variants.

    By the same path as extraction, from the recordings that the store was made of; the rows of
    episodes whose recordings changed are left out and named. Raises `StoreMismatch` where the
    params describe features of another kind than the store's.

    The tolerance is `verify.tolerance`, else that of the coarser of compute and storage dtype.
    """
    store = FeatureStore.open(path)
    with closing(ContentDigests(ledger_path(path))) as digests:
        surveyed = survey(params, digests)
    _refuse_other_spec(store, surveyed)
    recordings = {one.digest: one.recording for one in surveyed.episodes}
    known = [episode for episode in store.episodes if episode.digest in recordings]
    rows = _choice(known, params.verify.reextract, params.verify.seed)
    unchecked = tuple(one.id for one in store.episodes if one.digest not in recordings)
    tolerance = params.verify.tolerance or _tolerance(store.spec)
    if not len(rows):
        return Reextraction((), tolerance, unchecked, ())
    say(f"computing {len(rows)} rows again")
    vlm = FrozenVLM.load(params.vlm, surveyed.spec, params.extract.device)
    by_episode = [recordings.get(episode.digest) for episode in store.episodes]
    found = [
        _deviation(store, ready, features)
        for ready, features in tqdm(
            _computed(store, surveyed, by_episode, rows, vlm, params),
            "reextract",
            total=len(rows),
            unit="row",
            disable=None,
        )
    ]
    return Reextraction(
        tuple(sorted(found, key=lambda one: -np.nan_to_num(one.relative, nan=np.inf))),
        tolerance,
        unchecked,
        tuple(_environment_differences(store.attrs["environment"], rows, vlm.environment)),
    )


def _refuse_other_spec(store: FeatureStore, surveyed: Survey) -> None:
    if store.spec["digest"] == surveyed.spec.digest:
        return
    lines = [f"  {line}" for line in differences(store.spec, surveyed.spec.attrs())]
    raise StoreMismatch(
        "\n".join(
            [
                f"{store.path}: the params describe other features than the store holds, which "
                "cannot be compared (store -> params):",
                *lines,
                "Run with the params that it was extracted with, or extract it anew.",
            ]
        )
    )


def _choice(episodes: Sequence[Episode], count: int, seed: int) -> NDArray[np.int64]:
    """That many different rows of these episodes, ascending."""
    rows = np.concatenate(
        [np.zeros(0, np.int64), *(np.array(one.vl_rows, np.int64) for one in episodes)]
    )
    chosen = np.random.default_rng(seed).choice(rows, min(count, len(rows)), replace=False)
    return np.sort(chosen)


def _computed(
    store: FeatureStore,
    surveyed: Survey,
    recordings: Sequence[Recording | None],
    rows: NDArray[np.int64],
    vlm: FrozenVLM,
    params: Params,
) -> Iterator[tuple[ReadyRow, NDArray[Any]]]:
    """Each row and its features (variant x slot, dim) of today, as they would be stored."""
    spec, frame_time = surveyed.spec, store.array("vl/frame_time")
    present = [one for one in recordings if one is not None]
    # Episodes that are gone have none of the chosen rows; any recording may stand in their place.
    by_episode = [one if one is not None else present[0] for one in recordings]
    starts = store.array("episode/vl_start")
    ranges = RowFrames(by_episode, starts, frame_time, spec.views).ranges(rows, RANGE_ROWS)
    preparation = RowPreparation(Preparer(params.vlm, spec), spec, known=())
    prepared = in_background(ranges, preparation.prepare, params.extract.decode_threads)
    ready = (row for rows in prepared for row in rows if isinstance(row, ReadyRow))
    encoder = Encoder(vlm, params.extract.batch_size, spec.variants)
    for batch, features in encoder.encoded(ready):
        yield from zip(batch, features, strict=True)


def _deviation(store: FeatureStore, ready: ReadyRow, today: NDArray[Any]) -> Deviation:
    dtype = str(store.spec["storage_dtype"])
    stored = _numbers(store.array(FEATURES)[ready.row], dtype)
    apart = np.abs(_numbers(today, dtype) - stored).max(axis=-1)
    rms = np.sqrt(np.mean(stored**2, axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(apart == 0, 0.0, apart / rms)  # a slot of zeros may stay one
    slot = int(np.argmax(np.nan_to_num(relative, nan=np.inf)))
    return Deviation(
        row=ready.row,
        absolute=float(apart.max()),
        relative=float(relative[slot]),
        slot=slot,
        same_pixels=store.array("vl/key")[ready.row].tobytes() == ready.key,
        where=ready.where,
    )


def _numbers(values: NDArray[Any], dtype: str) -> NDArray[np.float64]:
    """Features (slot, dim) as numbers; bfloat16 is stored as its bits."""
    tensor = torch.from_numpy(np.ascontiguousarray(values))
    return (tensor.view(torch.bfloat16) if dtype == "bfloat16" else tensor).double().numpy()


def _tolerance(spec: Mapping[str, Any]) -> float:
    return max(TOLERANCES[spec[name]] for name in ("compute_dtype", "storage_dtype"))


def _environment_differences(
    recorded: Sequence[Mapping[str, Any]], rows: NDArray[np.int64], today: Mapping[str, Any]
) -> list[str]:
    """Where today's software and hardware differ from what these rows were computed with."""
    lines: list[str] = []
    for noted in recorded:
        start, stop = noted["rows"]
        if ((rows >= start) & (rows < stop)).any():
            then = {name: value for name, value in noted.items() if name != "rows"}
            lines += differences(then, today)
    return sorted(set(lines))
