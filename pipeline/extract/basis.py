"""The basis of a new store: fitted on a sample of its rows before any of them is written."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.projection import SAMPLE_ROWS, SLOTS_A_ROW, Basis, fit_map
from pipeline.data.episode import RowFrames
from pipeline.extract.encoder import Encoder
from pipeline.extract.rows import ReadyRow, RowPreparation
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.store.episodes import episode_arrays
from pipeline.vlm.qwen import FrozenVLM

_BATCH = 8
"""Not the fastest size: with another one every time, the basis would not have the same bits."""


def fit_basis(surveyed: Survey, checked: Sequence[CheckedEpisode]) -> tuple[Basis, str]:
    """The basis of the projected features of these episodes, and a line for people about it.

    Rows are evenly spread over all episodes. Raises what decoding and the model raise, and
    `ConfigError` where a group of slots has too few features to fit so many numbers.
    """
    spec = surveyed.spec.whole
    assert spec is not None, "only projected features have a basis"
    whole = replace(spec, document=spec.document | {"storage_dtype": "float32"}, variants=1)
    raw = replace(surveyed, spec=whole, vlm=surveyed.vlm.model_copy(update={"variants": 1}))
    times = episode_arrays(checked, [source.name for source in raw.data.sources], whole.views)
    vl_start, frame_time = times["episode/vl_start"], times["vl/frame_time"]
    count = min(SAMPLE_ROWS, len(frame_time))
    rows = np.arange(count, dtype=np.int64) * len(frame_time) // count
    frames = RowFrames(raw.recordings, vl_start, frame_time, whole.views)
    preparation = RowPreparation(raw, ())
    ready = (
        row
        for part in frames.ranges(rows, _BATCH)
        for row in preparation.prepare(part)
        if isinstance(row, ReadyRow)  # all: no other store is known
    )
    vlm = FrozenVLM.load(raw.vlm, whole, raw.extract.device)
    sample: list[list[NDArray[np.float32]]] = [[] for _ in whole.groups]
    with tqdm(None, "fit the basis", count, unit="row", disable=None) as bar:
        encoded = (row for _, features in Encoder(vlm, _BATCH).encoded(ready) for row in features)
        for number, values in enumerate(encoded):
            groups = np.split(values, np.cumsum(whole.groups)[:-1])
            for kept, group in zip(sample, groups, strict=True):
                there = group[group.any(axis=1)]  # zeros are of missing views
                # Each row gives the slots that follow those of the row before.
                turn = np.arange(min(len(there), SLOTS_A_ROW)) + number * SLOTS_A_ROW
                kept.append(there[turn % max(1, len(there))])
            bar.update()
    fitted = [fit_map(np.concatenate(kept), surveyed.spec.dim) for kept in sample]
    least = min(share for _, share in fitted)
    return Basis(np.stack([affine for affine, _ in fitted])), (
        f"basis of {surveyed.spec.dim} of {whole.dim} numbers a slot, fitted on {count} rows: "
        f"keeps {least:.1%} or more of the variance of standardised channels"
    )
