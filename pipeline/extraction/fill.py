"""Fill a laid-out build with feature rows: taken over where they are known, else computed."""

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.config import Params
from pipeline.device import resolve_device
from pipeline.digests import ContentDigests
from pipeline.extraction.encoder import Encoder
from pipeline.extraction.rows import KnownRow, ReadyRow, RowPreparation, in_background, spans_of
from pipeline.extraction.survey import Survey
from pipeline.store import Donor, StoreBuild
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM

_AUTO_BATCH = defaultdict(lambda: 8, {"cuda": 32})


@dataclass(frozen=True)
class ExtractionReport:
    """What was done."""

    store: Path
    rows: int
    taken: int
    """Rows taken over from an earlier store or build."""
    computed: int
    seconds: float
    """Of preparing, encoding and committing."""


def fill(
    build: StoreBuild,
    surveyed: Survey,
    donors: Sequence[Donor],
    params: Params,
    digests: ContentDigests,
    missing: NDArray[np.int64],
) -> ExtractionReport:
    """Fill in the missing rows: from donors where its frames are known, else by the model."""
    begun = time.monotonic()
    layout = Donor(build.part)
    by_digest = {one.digest: one for one in surveyed.episodes}
    recordings = [by_digest[digest].recording for digest in layout.episode_digests]
    vl_start = layout.episode_edges("vl")
    frame_time = build.files("vl/frame_time").read(0, int(vl_start[-1]))
    with tqdm(
        total=int(vl_start[-1]),
        initial=int(vl_start[-1]) - len(missing),
        desc="extract",
        unit="row",
        disable=None,
        smoothing=0.05,
    ) as progress:
        taken = _take_over(build, layout, donors, frame_time, missing, progress)
        missing = np.setdiff1d(missing, taken)
        computed = by_key = 0
        if len(missing):
            spec = surveyed.spec
            spans = spans_of(recordings, vl_start, frame_time, spec.views, missing, spec.variants)
            preparation = RowPreparation(Preparer(params.vlm, spec), spec, donors)
            rows = in_background(spans, preparation.prepare, params.extract.decode_threads)
            computed, by_key = _encode_all(build, rows, surveyed, params, digests, progress)
    layout.close()
    seconds = time.monotonic() - begun
    return ExtractionReport(build.target, int(vl_start[-1]), len(taken) + by_key, computed, seconds)


def _take_over(
    build: StoreBuild,
    layout: Donor,
    donors: Sequence[Donor],
    frame_time: NDArray[np.float64],
    missing: NDArray[np.int64],
    progress: "tqdm[NoReturn]",
) -> list[int]:
    """Copy rows of frames that a donor has seen, an episode at a time, without decoding one."""
    vl_start = layout.episode_edges("vl")
    taken: list[int] = []
    wanted = set(missing.tolist())
    for episode, (content, instruction) in enumerate(layout.episode_said):
        rows = range(*vl_start[episode : episode + 2])
        for donor in donors:
            keys = donor.keys_of(content, instruction)
            found = [
                KnownRow(row, key, values, donor.environment_of(key))
                for row in rows
                if row in wanted
                and (key := keys.get(frame_time[row].tobytes())) is not None
                and (values := donor.take(key)) is not None
            ]
            _commit_known(build, found)
            progress.update(len(found))
            taken += [one.row for one in found]
            wanted -= {one.row for one in found}
    return taken


def _commit_known(build: StoreBuild, known: Sequence[KnownRow]) -> None:
    by_environment: dict[int, list[KnownRow]] = defaultdict(list)
    for one in known:
        by_environment[build.environment_index(one.environment)].append(one)
    for number, rows in by_environment.items():
        features = np.stack([one.features for one in rows])
        build.commit([one.row for one in rows], features, [one.key for one in rows], number)


def _encode_all(
    build: StoreBuild,
    rows: Iterator[KnownRow | ReadyRow],
    surveyed: Survey,
    params: Params,
    digests: ContentDigests,
    progress: "tqdm[NoReturn]",
) -> tuple[int, int]:
    """Commit every row as it comes; the model is loaded when the first row needs it."""
    computed = known = 0
    encoder: Encoder | None = None
    number, begun = 0, 0.0

    def commit(batch: list[ReadyRow]) -> int:
        assert encoder is not None
        done = 0
        for part, features in encoder.encode(batch):
            build.commit([one.row for one in part], features, [one.key for one in part], number)
            progress.update(len(part))
            done += len(part)
        return done

    for row in rows:
        if isinstance(row, KnownRow):
            _commit_known(build, [row])
            progress.update()
            known += 1
            continue
        if encoder is None:
            vlm = FrozenVLM.load(params.vlm, surveyed.spec, params.extract.device)
            encoder = Encoder(vlm, _batch_size(params), surveyed.spec.variants)
            number = build.environment_index(vlm.environment)
            begun = time.monotonic()
        if batch := encoder.add(row):
            computed += commit(batch)
    if encoder is not None:
        for batch in encoder.rest():
            computed += commit(batch)
        digests.note_rate(rate_name(surveyed, params), computed / (time.monotonic() - begun))
    return computed, known


def rate_name(surveyed: Survey, params: Params) -> str:
    """Under which name the speed of this model on this device is remembered."""
    return f"{surveyed.spec.digest} {params.extract.device}"


def _batch_size(params: Params) -> int:
    if params.extract.batch_size != "auto":
        return params.extract.batch_size
    return _AUTO_BATCH[resolve_device(params.extract.device).type]
