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

from pipeline.base.bfloat16 import widen
from pipeline.base.config import Params
from pipeline.base.differences import describe, differences
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import NumericsError, StoreMismatch
from pipeline.data import Recording
from pipeline.data.row_range import RowRange
from pipeline.extract.survey import survey
from pipeline.store import FEATURES, Episode, FeatureStore
from pipeline.store.environments import environment_runs
from pipeline.store.integrity.verification import capped
from pipeline.vlm.feature_spec import FeatureSpec, row_key
from pipeline.vlm.preparation import PreparedRow, Preparer
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
        return [row for row in self.deviations if not row.relative <= self.tolerance]

    def lines(self) -> list[str]:
        """For people."""
        gone = "cannot be checked, its recording changed or is gone: "
        unchecked = capped([gone + episode for episode in self.unchecked], "episodes")
        if not self.deviations:
            return ["no row can be computed again", *unchecked]
        worst = self.deviations[0]
        other = [row.where for row in self.deviations if not row.same_pixels]
        return [
            f"computed {len(self.deviations)} rows again; the largest deviation is "
            f"{worst.relative:.2e} of its slot's root mean square "
            f"(absolute {max(row.absolute for row in self.deviations):.2e}), {self.tolerance:.0e} "
            f"is tolerated: {worst.where}, slot {worst.slot}",
            *capped([f"other pixels than the store's: {where}" for where in other], "rows"),
            *(["the decoder of today gives other pixels than that of the store"] if other else []),
            *(f"environment, {line}" for line in self.environment),
            *unchecked,
        ]

    def refusals(self) -> list[str]:
        """For people: the rows beyond the tolerance."""
        lines = [
            f"{row.where}: slot {row.slot} deviates {row.relative:.2e} of its root mean square, "
            f"{row.absolute:.2e} absolute"
            + ("" if row.same_pixels else "; its frames decode to other pixels")
            for row in self.beyond
        ]
        return capped(lines, "rows beyond the tolerance")


def reextract(path: Path, params: Params, say: Callable[[str], None]) -> Reextraction:
    """Compute `verify.reextract` random rows of a store again, each with all its variants.

    From the recordings that the store was made of; the rows of episodes whose recordings changed
    are left out and named. Raises `StoreMismatch` where the params describe features of another
    kind than the store's, and `NumericsError` where a feature is NaN or infinite.

    The tolerance is `verify.tolerance`, else that of the coarser of compute and storage dtype.
    """
    store = FeatureStore.open(path)
    with closing(ContentDigests(ledger_path(path))) as digests:
        surveyed = survey(params, digests)
    _refuse_other_spec(store, surveyed.spec)
    recordings = {episode.digest: episode.recording for episode in surveyed.episodes}
    known = [episode for episode in store.episodes if episode.digest in recordings]
    unchecked = tuple(one.id for one in store.episodes if one.digest not in recordings)
    dtypes = (store.spec["compute_dtype"], store.spec["storage_dtype"])
    tolerance = params.verify.tolerance or max(TOLERANCES[dtype] for dtype in dtypes)
    rows = _draw_rows(known, params.verify.reextract, params.verify.seed)
    if not len(rows):
        return Reextraction((), tolerance, unchecked, ())
    say(f"computing {len(rows)} rows again")
    vlm = FrozenVLM.load(params.vlm, surveyed.spec, params.extract.device)
    environments = environment_runs(store.attrs["environment"], rows)
    differing = (describe(differences(then, vlm.environment)) for then, _ in environments)
    computed = _deviations(store, known, recordings, rows, vlm, surveyed.spec, params)
    deviations = list(tqdm(computed, "reextract", total=len(rows), unit="row", disable=None))
    return Reextraction(
        tuple(sorted(deviations, key=lambda row: -np.nan_to_num(row.relative, nan=np.inf))),
        tolerance,
        unchecked,
        tuple(sorted({line for lines in differing for line in lines})),
    )


def _refuse_other_spec(store: FeatureStore, spec: FeatureSpec) -> None:
    if store.spec["digest"] == spec.digest:
        return
    lines = describe(differences(store.spec, spec.attrs()))
    raise StoreMismatch(
        f"{store.path}: the params describe other features than the store holds, which cannot be "
        "compared (store -> params):\n"
        + "\n".join(f"  {line}" for line in lines)
        + "\nRun with the params that it was extracted with, or extract it anew."
    )


def _draw_rows(episodes: Sequence[Episode], count: int, seed: int) -> NDArray[np.int64]:
    """That many different rows of these episodes, ascending."""
    rows = np.array([row for episode in episodes for row in episode.vl_rows], np.int64)
    drawn = np.random.default_rng(seed).choice(rows, min(count, len(rows)), replace=False)
    return np.sort(drawn)


def _deviations(
    store: FeatureStore,
    episodes: Sequence[Episode],
    recordings: Mapping[str, Recording],
    rows: NDArray[np.int64],
    vlm: FrozenVLM,
    spec: FeatureSpec,
    params: Params,
) -> Iterator[Deviation]:
    """That of each of these rows, in order, from its recording by the digest of its episode."""
    preparer, frame_time = Preparer(params.vlm, spec), store.array("vl/frame_time")
    size = params.extract.batch_size
    for episode in episodes:
        own = rows[np.isin(rows, episode.vl_rows)]
        if not len(own):
            continue
        recording = recordings[episode.digest]
        rows_of = RowRange.of(recording, recording.cameras(), own, frame_time[own], spec.views)
        for row, frames in rows_of.read():
            where = f"{recording.path}, VL row {row}"
            key = row_key(spec, preparer.render(recording.instruction, list(frames)), frames)
            variants = preparer.prepare_variants(recording.instruction, frames, key)
            today = _encode(vlm, variants, len(variants) if size == "auto" else size, where)
            same_pixels = store.array("vl/key")[row].tobytes() == key
            yield _compare(store.array(FEATURES)[row], today, row, same_pixels, where)


def _encode(
    vlm: FrozenVLM, variants: Sequence[PreparedRow], size: int, where: str
) -> NDArray[np.float64]:
    """The features (variant x slot, dim) of a row, as they would be stored."""
    parts = (variants[start : start + size] for start in range(0, len(variants), size))
    try:
        features = torch.cat([vlm.encode(part)[0] for part in parts])
    except NumericsError as error:
        raise NumericsError(f"{where}: {error}") from None
    return features.flatten(0, 1).double().numpy()


def _compare(
    stored: NDArray[Any], today: NDArray[np.float64], row: int, same_pixels: bool, where: str
) -> Deviation:
    numbers = widen(stored).astype(np.float64)
    apart = np.abs(today - numbers).max(axis=-1)
    rms = np.sqrt(np.mean(numbers**2, axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(apart == 0, 0.0, apart / rms)  # a slot of zeros may stay one
    slot = int(np.argmax(np.nan_to_num(relative, nan=np.inf)))
    return Deviation(row, float(apart.max()), float(relative[slot]), slot, same_pixels, where)
