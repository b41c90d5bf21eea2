"""What a dask worker does: it prepares, encodes and writes ranges of rows, which others mark.

Each worker process holds one model. Its threads take turns with it: while one encodes, the others
prepare.
"""

import socket
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from distributed import Worker, WorkerPlugin, get_worker
from numpy.typing import NDArray

from pipeline.base.differences import describe, differences
from pipeline.base.digests import file_digest
from pipeline.base.errors import ConfigError, NumericsError, RecordingError, StoreIncomplete
from pipeline.extract.engine import FeatureBlock, RowEngine, WrittenRows, row_frames
from pipeline.extract.rows import Row
from pipeline.extract.survey import Survey
from pipeline.store import RowSource, StoreBuild, part_path, read_plan
from pipeline.store.schema import read_specs
from pipeline.vlm.feature_spec import feature_spec


def compute_rows(plugin: str, rows: NDArray[np.int64]) -> list[WrittenRows] | Exception:
    """The task: write the features of these rows.

    Raises `RecordingError` or `NumericsError` where a recording cannot be computed, which dask
    tries again. What fails for every other row as well (no model, a full disk) is returned.
    """
    held: ExtractionPlugin = get_worker().plugins[plugin]  # pyright: ignore[reportAssignmentType]
    try:
        return held.compute(rows)
    except (RecordingError, NumericsError):
        raise
    except Exception as error:
        return error


@dataclass(frozen=True)
class ExtractionJob:
    """What every process of an extraction must know.

    `known` are stores and builds of the same feature spec, `folder` is where the coordinator runs:
    relative paths begin there.
    """

    surveyed: Survey
    known: tuple[Path, ...]
    folder: Path

    @property
    def name(self) -> str:
        """Of its plugin: an extraction that was killed is replaced by the next on its store."""
        return f"extraction of {self.surveyed.target.absolute()}"

    @property
    def local(self) -> bool:
        """Whether all its processes are on the coordinator's host."""
        return isinstance(self.surveyed.params.extract.workers, int)


class ExtractionPlugin(WorkerPlugin):
    """A worker's half of an extraction; also on workers that join later."""

    def __init__(self, job: ExtractionJob) -> None:
        self.job = job
        self.name = job.name

    def setup(self, worker: Worker) -> None:
        """Prepare to begin with the first task; whatever fails then is that task's error."""
        self._number = worker.name
        self._engine: RowEngine | None = None
        self._closed = False
        self._opening, self._model_turn, self._disk_turn = (threading.Lock() for _ in range(3))

    def teardown(self, worker: Worker) -> None:
        """Close the files, between two writes; a range that is still computed writes no more."""
        with self._opening, self._disk_turn:
            self._closed = True
            if self._engine is not None:
                self._engine = None
                self._build.close()

    def compute(self, rows: NDArray[np.int64]) -> list[WrittenRows]:
        """Write the features of these rows; equal ones among them are computed once."""
        engine = self._opened()
        prepared = _prepared(engine, rows)
        blocks: list[FeatureBlock] = []
        with self._model_turn:
            engine.encode(iter([prepared]), blocks.append)
        with self._disk_turn:
            if self._closed:
                raise StoreIncomplete(f"{self.name} has ended; its rows are nobody's")
            return [block.write(self._build) for block in blocks]

    def _opened(self) -> RowEngine:
        """The worker's engine; its files are opened on the first call."""
        surveyed = self.job.surveyed
        with self._opening:
            if self._engine is None:
                check_place(self.job)
                known = [RowSource(path) for path in self.job.known]
                specs = read_specs(part_path(surveyed.target))
                self._build = StoreBuild(surveyed.target, specs, surveyed.plan)
                frames = row_frames(self._build, surveyed)
                device = device_of(self.job, self._number)
                self._engine = RowEngine(surveyed, frames, known, device)
            return self._engine


def _prepared(engine: RowEngine, rows: NDArray[np.int64]) -> list[Row]:
    firsts: dict[bytes, int] = {}
    try:
        parts = engine.frames.ranges(rows)
        return [row for part in parts for row in engine.prepare(part, firsts)]
    except RecordingError:
        raise
    except Exception as error:  # a damaged recording may raise anything in its decoder
        raise RecordingError(f"{type(error).__name__}: {error}") from None


def device_of(job: ExtractionJob, worker_name: object) -> str:
    """The device of a worker: local ones take turns over the GPUs, others use the first they see.

    As dask-cuda, and CUDA_VISIBLE_DEVICES, show each worker its own first.
    """
    wanted, devices = job.surveyed.params.extract.device, torch.cuda.device_count()
    if job.local and isinstance(worker_name, int) and wanted in ("auto", "cuda") and devices > 1:
        return f"cuda:{worker_name % devices}"
    return wanted


def check_place(job: ExtractionJob) -> None:
    """Raise where this worker does not see the files that the coordinator sees, or not the same."""
    here, host = Path.cwd(), socket.gethostname()
    if not job.folder.is_dir() or not here.samefile(job.folder):
        raise ConfigError(
            f"the worker on {host} runs in {here}, the coordinator in {job.folder}: relative paths "
            f"would not be the same. Start every worker with `cd {job.folder}`, on a file system "
            "that all hosts share."
        )
    surveyed, part = job.surveyed, part_path(job.surveyed.target)
    if read_plan(part) != surveyed.plan:
        raise StoreIncomplete(
            f"the worker on {host} does not see the build {part}. Workers on other hosts need a "
            "file system that all hosts share: set extract.store to a folder of one."
        )
    if not job.local:
        params, spec = surveyed.params, surveyed.spec
        ours = feature_spec(params.vlm, params.extract.dtype, spec.views, file_digest)
        if ours.digest != spec.digest:
            lines = "; ".join(describe(differences(ours.attrs(), spec.attrs())))
            raise ConfigError(
                f"the worker on {host} would compute other features than the coordinator asks "
                f"for: {lines}. Give it the same checkpoint and the same version of this package."
            )
