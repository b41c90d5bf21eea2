"""Stage one as a contender: its own `fill`, in steady state, with the model loaded beforehand."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, repeat
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.workload import Workload
from pipeline.data.episode import RowRange
from pipeline.extract.encoder import Encoder
from pipeline.extract.engine import compute_here, fill, in_background
from pipeline.extract.rows import ReadyRow, Row, RowPreparation
from pipeline.vlm.qwen import FrozenVLM


class StageOne:
    """Fills a laid-out store with the workload's rows."""

    def __init__(self, workload: Workload, vlm: FrozenVLM, batch_size: int | None) -> None:
        """Without a batch size, the one that `auto` settles on."""
        self._workload, self._vlm = workload, vlm
        self.batch_size = batch_size or _settled(workload, vlm)
        self.shares: list[tuple[float, float]] = []
        """Of each run's time since it had its model: what that worked, and waited for frames."""
        self._build = workload.fresh_build()

    def prepare(self) -> None:
        """Lay out an empty store in place of the one before."""
        self._build.close()
        self._build = self._workload.fresh_build()

    @property
    def row_bytes(self) -> int:
        """Bytes of a row's features."""
        return self._build.specs["vl/features"].row_bytes

    def run_every_frame(self) -> None:
        """Fill the store, computing anew what is shown again: no row or frame is spared."""
        with ExitStack() as stack:
            stack.enter_context(patch.object(RowPreparation, "prepare", prepare_all))
            stack.enter_context(patch("pipeline.vlm.collation.unique", _all))
            self.run()

    def run(self) -> None:
        """Fill the store."""
        work = self._workload
        extract = work.params.extract.model_copy(update={"batch_size": self.batch_size})
        surveyed = replace(work.survey, extract=extract)
        # Stage one takes the model that is there instead of loading it again.
        with patch.object(FrozenVLM, "load", return_value=self._vlm):
            done = fill(self._build, surveyed, [], work.digests, work.missing, compute_here)
        assert done.computed + done.repeated == len(work.missing), done
        _, model, waited = done.speed
        assert model is not None and waited is not None
        self.shares.append((model, waited))

    def features(self) -> NDArray[np.float32]:
        """Features (row, dim) of the last run."""
        return self._build.files("vl/features").read(0, len(self._workload.missing))[:, 0]


_prepare = RowPreparation.prepare


def prepare_all(preparation: RowPreparation, rows: RowRange, firsts: object) -> list[Row]:
    """Every row made ready, as if they all differed."""
    return _prepare(preparation, rows, None)


def _all(images: Sequence[NDArray[np.uint8]]) -> tuple[Sequence[NDArray[np.uint8]], list[int]]:
    """Every image, as if they all differed."""
    return images, list(range(len(images)))


def _settled(workload: Workload, vlm: FrozenVLM) -> int:
    """The batch size that `auto` settles on when it sees these rows over and over."""
    preparation = RowPreparation(workload.survey, [])
    threads = workload.params.extract.decode_threads
    rows = [
        row
        for prepared in in_background(workload.ranges(), preparation.prepare, threads)
        for row in prepared
        if isinstance(row, ReadyRow)
    ]
    encoder = Encoder(vlm, "auto")
    for _ in encoder.encoded(chain.from_iterable(repeat(rows))):
        if encoder.size.settled:
            # In a larger batch, rows would stand twice and be seen once.
            return min(encoder.size.current, len(rows))
    raise AssertionError("rows without end came to an end")
