"""Compute rows in this process: threads prepare, the model encodes, a thread commits."""

import json
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import chain

from pipeline.extract.commits import Commits
from pipeline.extract.encoder import Encoder
from pipeline.extract.rows import (
    SPAN_ROWS,
    KnownRow,
    ReadyRow,
    RepeatedRow,
    RowPreparation,
    in_background,
    spans_of,
)
from pipeline.extract.work import Computed, Work
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM


def compute_here(work: Work) -> Computed:
    """Commit every missing row; the model is loaded when the first row needs it."""
    return _Session(work).compute()


class _Session:
    """The model, once it is loaded, and how long it waited."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self._encoder: Encoder | None = None
        self._waited_s = 0.0

    def compute(self) -> Computed:
        work, spec = self._work, self._work.spec
        preparation = RowPreparation(Preparer(work.params.vlm, spec), spec, work.donors)
        spans = spans_of(
            work.recordings,
            work.vl_start,
            work.frame_time,
            spec.views,
            work.missing,
            spec.variants,
        )
        threads = work.params.extract.decode_threads
        prepared = in_background(spans, preparation.prepare_once, threads, self._spans_ahead)
        computed, begun = 0, time.monotonic()
        with Commits(work.build, work.done) as commits, closing(prepared):
            rows = commits.model_rows(self._waiting(prepared))
            if (first := next(rows, None)) is not None:
                vlm, self._encoder = self._loaded()
                begun, self._waited_s = time.monotonic(), 0.0
                for batch, features in self._encoder.encoded(chain([first], rows)):
                    commits.computed(batch, features, vlm.environment)
                    computed += len(batch)
                self._remember(vlm, self._encoder)
        if self._encoder is None:
            return Computed(known=commits.known)
        seconds = time.monotonic() - begun
        return Computed(
            computed,
            commits.known,
            commits.repeated,
            computed / seconds,
            self._encoder.model_s / seconds,
            self._waited_s / seconds,
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
        extract, spec = self._work.params.extract, self._work.spec
        vlm = FrozenVLM.load(self._work.params.vlm, spec, extract.device, extract.compile)
        size = extract.batch_size
        if size == "auto":
            size = self._work.digests.batch_size(self._size_name(vlm)) or "auto"
        return vlm, Encoder(vlm, size, spec.variants)

    def _remember(self, vlm: FrozenVLM, encoder: Encoder) -> None:
        if self._work.params.extract.batch_size == "auto" and encoder.settled:
            self._work.digests.note_batch_size(self._size_name(vlm), encoder.batch_size)

    def _size_name(self, vlm: FrozenVLM) -> str:
        """Under which the best batch size of this model on this device is remembered."""
        return f"{self._work.spec.digest} {json.dumps(vlm.environment, sort_keys=True)}"
