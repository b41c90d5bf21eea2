"""Compute stored rows again with today's software and hardware, and compare."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.arrays import code_size, widen
from pipeline.base.config import Params
from pipeline.base.differences import describe, differences
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import StoreMismatch
from pipeline.base.text import capped
from pipeline.data.episode import RowFrames
from pipeline.extract.encoder import Encoder
from pipeline.extract.rows import ReadyRow, RowPreparation
from pipeline.extract.survey import survey
from pipeline.store import FEATURES, FeatureStore
from pipeline.store.writer import environment_runs
from pipeline.vlm.qwen import FrozenVLM
from pipeline.vlm.slots import slot_deviations, tolerance_of


@dataclass(frozen=True)
class Deviation:
    """How far a row that was computed again is from the stored one.

    `relative` is the largest of `slot_deviations` of all variants and slots; `slot` is the index of
    that slot, counted over variants and slots. `same_pixels` says whether the frames and prompt
    still give the stored key. `where` names the recording and the row.
    """

    row: int
    relative: float
    slot: int
    same_pixels: bool
    where: str

    def __str__(self) -> str:
        pixels = "" if self.same_pixels else "; the decoder of today gives other pixels"
        return f"{self.where}: slot {self.slot} deviates {self.relative:.2e} of its size{pixels}"


@dataclass(frozen=True)
class Reextraction:
    """The deviations of all computed rows, the largest first.

    `unchecked` has the ids of episodes whose recordings changed or are gone; `environment` lists
    how the software and hardware of the rows differ from the present ones.
    """

    deviations: tuple[Deviation, ...]
    tolerance: float
    unchecked: tuple[str, ...]
    environment: tuple[str, ...]

    @property
    def beyond(self) -> list[Deviation]:
        """Rows beyond the tolerance; a NaN is infinitely far."""
        return [row for row in self.deviations if row.relative > self.tolerance]

    def lines(self) -> list[str]:
        """The result in lines for people."""
        gone = "cannot be checked, its recording changed or is gone: "
        unchecked = capped([gone + episode for episode in self.unchecked], "episodes")
        if not self.deviations:
            return ["no row can be computed again", *unchecked]
        other = [str(row) for row in self.deviations if not row.same_pixels]
        return [
            f"computed {len(self.deviations)} rows again, {self.tolerance:.0e} of a slot's size is "
            f"tolerated; the largest deviation: {self.deviations[0]}",
            *capped(other, "rows of other pixels than the store's"),
            *(f"environment, {line}" for line in self.environment),
            *unchecked,
        ]


def reextract(path: Path, params: Params, say: Callable[[str], None]) -> Reextraction:
    """Compute `verify.reextract` random rows of a store again, each with all its variants.

    Reads the recordings that the store was made of; leaves out and names episodes whose recordings
    changed. Raises `StoreMismatch` where the params describe other features than the store's, and
    `NumericsError` where a feature is NaN or infinite.

    The tolerance is `verify.tolerance`, or by default that of the coarser of the compute and the
    storage dtype.
    """
    store, options = FeatureStore.open(path), params.verify
    own = params.extract.model_copy(update={"store": path})  # whose basis is taken
    with closing(ContentDigests(ledger_path(path))) as digests:
        surveyed = survey(params.model_copy(update={"extract": own}), digests)
    spec = surveyed.spec
    if other := differences(store.spec, spec.attrs()):
        raise StoreMismatch(
            f"{path}: the params describe other features than the store holds, which cannot be "
            "compared (store -> params):\n  "
            + "\n  ".join(describe(other))
            + "\nRun with the params that it was extracted with, or extract it anew."
        )
    current = {episode.digest: episode.recording for episode in surveyed.episodes}
    known = [episode for episode in store.episodes if episode.digest in current]
    unchecked = tuple(episode.id for episode in store.episodes if episode.digest not in current)
    tolerance = options.tolerance or tolerance_of(store.spec)
    stored = np.array([row for episode in known for row in episode.vl_rows], np.int64)
    generator = np.random.default_rng(options.seed)
    rows = np.sort(generator.choice(stored, min(options.reextract, len(stored)), replace=False))
    if not len(rows):
        return Reextraction((), tolerance, unchecked, ())
    say(f"computing {len(rows)} rows again")
    vlm = FrozenVLM.load(params.vlm, spec, params.extract.device)
    environments = environment_runs(store.attrs["environment"], rows)
    differing = (describe(differences(then, vlm.environment)) for then, _ in environments)
    recordings = {episode.index: current[episode.digest] for episode in known}
    vl_start, frame_time = (store.array(name) for name in ("episode/vl_start", "vl/frame_time"))
    frames = RowFrames(recordings, vl_start, frame_time, spec.views)
    preparation = RowPreparation(surveyed, ())
    prepared = (row for part in frames.ranges(rows) for row in preparation.prepare(part))
    ready = (row for row in prepared if isinstance(row, ReadyRow))  # all: no other store is known
    encoder = Encoder(vlm, params.extract.batch_size, spec.variants)
    deviations: list[Deviation] = []
    with tqdm(None, "reextract", len(rows), unit="row", disable=None) as bar:
        for batch, features in encoder.encoded(ready):
            deviations += map(partial(_compare, store), batch, features)
            bar.update(len(batch))
    return Reextraction(
        tuple(sorted(deviations, key=lambda row: -row.relative)),
        tolerance,
        unchecked,
        tuple(sorted({line for lines in differing for line in lines})),
    )


def _compare(store: FeatureStore, row: ReadyRow, features: NDArray[Any]) -> Deviation:
    """Compare the stored row with new features (variant x slot, dim), both in storage dtype."""
    stored = store.array(FEATURES)[row.row]
    deviations = slot_deviations(widen(stored), widen(features), code_size(stored))
    slot = int(deviations.argmax())
    same_pixels = store.array("vl/key")[row.row].tobytes() == row.key
    return Deviation(row.row, float(deviations[slot]), slot, same_pixels, row.where)
