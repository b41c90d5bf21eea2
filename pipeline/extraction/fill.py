"""Fill a laid-out build with feature rows: taken over where they are known, else computed."""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.config import Params
from pipeline.digests import ContentDigests
from pipeline.extraction.commits import Commits, commit_known
from pipeline.extraction.encoder import Encoder
from pipeline.extraction.rows import (
    SPAN_ROWS,
    KnownRow,
    ReadyRow,
    RepeatedRow,
    RowPreparation,
    Span,
    in_background,
    spans_of,
)
from pipeline.extraction.survey import Survey
from pipeline.recordings import Recording
from pipeline.store import Donor, StoreBuild
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM


@dataclass(frozen=True)
class Computed:
    """What came of the rows that no donor had by their frames."""

    computed: int = 0
    known: int = 0
    """Rows that a donor turned out to have once their frames were decoded."""
    repeated: int = 0
    """Rows equal to another that was computed."""
    seconds: float = 0.0
    """From the model being loaded to the last row being on disk."""
    model_s: float = 0.0
    """Of these, the model worked."""
    waited_s: float = 0.0
    """Of these, the model waited for frames to be decoded and prepared."""


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
    repeated: int = 0
    """Rows equal to another that was computed."""
    model_share: float | None = None
    """Of the time since the model was loaded, how much it worked; None where none was, here."""
    waited_share: float | None = None
    """Likewise, how much it waited for frames to be decoded and prepared."""


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
        found = Computed()
        if len(missing) and params.extract.workers != 0:
            found = _compute_on_cluster(
                build, surveyed, recordings, vl_start, frame_time, missing, donors, params, progress
            )
        elif len(missing):
            spec = surveyed.spec
            spans = spans_of(recordings, vl_start, frame_time, spec.views, missing, spec.variants)
            found = _Local(build, surveyed, donors, params, digests).compute(spans, progress)
    layout.close()
    return ExtractionReport(
        store=build.target,
        rows=int(vl_start[-1]),
        taken=len(taken) + found.known,
        computed=found.computed,
        seconds=time.monotonic() - begun,
        repeated=found.repeated,
        model_share=found.model_s / found.seconds if found.seconds else None,
        waited_share=found.waited_s / found.seconds if found.seconds else None,
    )


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
            progress.update(commit_known(build, found))
            taken += [one.row for one in found]
            wanted -= {one.row for one in found}
    return taken


def _compute_on_cluster(
    build: StoreBuild,
    surveyed: Survey,
    recordings: Sequence[Recording],
    vl_start: NDArray[np.int64],
    frame_time: NDArray[np.float64],
    missing: NDArray[np.int64],
    donors: Sequence[Donor],
    params: Params,
    progress: "tqdm[NoReturn]",
) -> Computed:
    """Let workers write the features; only their keys and checksums are written here."""
    from pipeline.extraction.cluster import compute_on_cluster

    computed = known = 0
    paths = [donor.path for donor in donors]
    for written in compute_on_cluster(
        build, surveyed.spec, recordings, vl_start, frame_time, missing, paths, params
    ):
        number = build.environment_index(written.environment)
        build.mark(written.rows, written.keys, written.checksums, number)
        progress.update(len(written.rows))
        computed += len(written.rows) * written.computed
        known += len(written.rows) * (not written.computed)
    return Computed(computed, known)


class _Local:
    """Computes rows in this process: threads prepare, the model encodes, a thread commits."""

    def __init__(
        self,
        build: StoreBuild,
        surveyed: Survey,
        donors: Sequence[Donor],
        params: Params,
        digests: ContentDigests,
    ) -> None:
        self._build = build
        self._surveyed = surveyed
        self._params = params
        self._digests = digests
        spec = surveyed.spec
        self._preparation = RowPreparation(Preparer(params.vlm, spec), spec, donors)
        self._encoder: Encoder | None = None
        self._waited_s = 0.0

    def compute(self, spans: Iterator[Span], progress: "tqdm[NoReturn]") -> Computed:
        """Commit every row; the model is loaded when the first row needs it."""
        threads = self._params.extract.decode_threads
        prepared = in_background(spans, self._preparation.prepare_once, threads, self._spans_ahead)
        computed, begun = 0, None
        with Commits(self._build, progress.update) as commits, closing(prepared):
            rows = commits.model_rows(self._waiting(prepared))
            if (first := next(rows, None)) is not None:
                vlm, encoder = self._loaded()
                begun, self._waited_s = time.monotonic(), 0.0
                for batch, features in encoder.encoded(chain([first], rows)):
                    commits.computed(batch, features, vlm.environment)
                    computed += len(batch)
                self._remember(vlm, encoder)
        if self._encoder is None or begun is None:
            return Computed(known=commits.known)
        seconds = time.monotonic() - begun
        self._digests.note_rate(rate_name(self._surveyed, self._params), computed / seconds)
        return Computed(
            computed,
            commits.known,
            commits.repeated,
            seconds,
            self._encoder.model_s,
            self._waited_s,
        )

    def _waiting(
        self, rows: Iterator[KnownRow | ReadyRow | RepeatedRow]
    ) -> Iterator[KnownRow | ReadyRow | RepeatedRow]:
        """The same rows; how long they were waited for is noted."""
        while True:
            begun = time.monotonic()
            row = next(rows, None)
            self._waited_s += time.monotonic() - begun
            if row is None:
                return
            yield row

    def _spans_ahead(self) -> int:
        """While the model has one batch, the next should be complete."""
        return 2 * self._encoder.batch_size // SPAN_ROWS + 1 if self._encoder else 0

    def _loaded(self) -> tuple[FrozenVLM, Encoder]:
        extract, spec = self._params.extract, self._surveyed.spec
        vlm = FrozenVLM.load(self._params.vlm, spec, extract.device, extract.compile)
        size = extract.batch_size
        if size == "auto":
            size = self._digests.batch_size(_size_name(self._surveyed, vlm)) or "auto"
        self._encoder = Encoder(vlm, size, spec.variants)
        return vlm, self._encoder

    def _remember(self, vlm: FrozenVLM, encoder: Encoder) -> None:
        if self._params.extract.batch_size == "auto" and encoder.settled:
            self._digests.note_batch_size(_size_name(self._surveyed, vlm), encoder.batch_size)


def _size_name(surveyed: Survey, vlm: FrozenVLM) -> str:
    """Under which name the best batch size of this model on this device is remembered."""
    return f"{surveyed.spec.digest} {json.dumps(vlm.environment, sort_keys=True)}"


def rate_name(surveyed: Survey, params: Params) -> str:
    """Under which name the speed of this model on this device is remembered."""
    return f"{surveyed.spec.digest} {params.extract.device}"
