"""What a dask worker does: decode, prepare and encode ranges of rows, and write their features.

Each worker process holds one model, loaded when a row first needs it. Its threads take turns with
the model: while one encodes, the others prepare.
"""

import json
import socket
import threading
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from distributed import Worker, WorkerPlugin, get_worker
from numpy.typing import NDArray

from pipeline.base.differences import describe, differences
from pipeline.base.digests import file_digest
from pipeline.base.errors import ConfigError, NumericsError, StoreIncomplete
from pipeline.data import CameraStream
from pipeline.data.row_range import RowRange
from pipeline.extract.encoder import Encoder
from pipeline.extract.job import Came, Job, Outcome, Piece, WrittenRows
from pipeline.extract.rows import KnownRow, ReadyRow, RowPreparation
from pipeline.store import RowSource, StoreBuild, part_path, read_plan
from pipeline.store.schema import read_specs
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM

_OPEN_EPISODES = 8


class ExtractionPlugin(WorkerPlugin):
    """Holds a worker's half of an extraction; also on workers that join later."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.name = job.name

    def setup(self, worker: Worker) -> None:
        """Prepare to begin with the first task; whatever fails then is that task's error."""
        self._worker_name = worker.name
        self._opening = threading.Lock()
        self._computer: RangeComputer | None = None

    def teardown(self, worker: Worker) -> None:
        """Let go of the model and the files."""
        with self._opening:
            if self._computer is not None:
                self._computer.close()
            self._computer = None

    def computer(self) -> "RangeComputer":
        """The worker's model and files, opened on the first call."""
        with self._opening:
            if self._computer is None:
                self._computer = RangeComputer(self.job, self._worker_name)
            return self._computer


def compute_pieces(plugin: str, pieces: Sequence[Piece]) -> Outcome:
    """The task: write the features of these rows; a piece that cannot be computed says why.

    Raises what would fail for every other row as well: no model, a full disk, no build.
    """
    held: Any = get_worker().plugins[plugin]
    computer: RangeComputer = held.computer()
    written: list[WrittenRows] = []
    failed: dict[int, str] = {}
    for place, piece in enumerate(pieces):
        try:
            made = computer.prepared(piece)
        except Exception as error:  # a damaged recording may raise anything in its decoder
            failed[place] = f"{type(error).__name__}: {error}"
            continue
        try:
            written += computer.written(made)
        except NumericsError as error:
            failed[place] = str(error)
    return Outcome(tuple(written), failed)


class RangeComputer:
    """The model, the build and the donors of one worker process; used from several threads."""

    def __init__(self, job: Job, worker_name: object) -> None:
        check_place(job)
        self._job = job
        self._worker_name = worker_name
        self._donors = [RowSource(path) for path in job.donors]
        self._build = StoreBuild(job.target, read_specs(part_path(job.target)), job.plan)
        self._preparation = RowPreparation(
            Preparer(job.params.vlm, job.spec), job.spec, self._donors
        )
        self._cameras: dict[int, Mapping[str, CameraStream]] = {}
        self._encoder: Encoder | None = None
        self._environment: Mapping[str, Any] = {}
        self._cameras_turn = threading.Lock()
        self._model_turn = threading.Lock()
        self._disk_turn = threading.Lock()
        self._closed = False

    def close(self) -> None:
        """Close the files, between two writes; a range that is still computed writes no more."""
        with self._disk_turn:
            self._closed = True
            self._build.close()
        for donor in self._donors:
            donor.close()

    def prepared(self, piece: Piece) -> list[KnownRow | ReadyRow]:
        """The decoded and prepared rows of a piece; raises what its recording makes it raise."""
        views = self._job.spec.views
        cameras = self._cameras_of(piece)
        span = RowRange.of(piece.recording, cameras, piece.rows, piece.frame_time, views)
        return self._preparation.prepare(span)

    def written(self, made: Sequence[KnownRow | ReadyRow]) -> Iterator[WrittenRows]:
        """Encode what has to be encoded, write it all, and say what is to be marked.

        Rows of equal key are encoded once.
        """
        known: dict[str, list[KnownRow]] = defaultdict(list)
        ready: dict[bytes, list[ReadyRow]] = defaultdict(list)
        for row in made:
            if isinstance(row, KnownRow):
                known[json.dumps(row.environment, sort_keys=True)].append(row)
            else:
                ready[row.key].append(row)
        for rows in known.values():
            features = np.stack([one.features for one in rows])
            yield self._write(rows, features, rows[0].environment, "known")
        if ready:
            with self._model_turn:
                batches = list(self._loaded().encoded(rows[0] for rows in ready.values()))
            for rows, features in batches:
                yield self._write(rows, features, self._environment, "computed")
                again = [(equal, at) for at, row in enumerate(rows) for equal in ready[row.key][1:]]
                if again:
                    equals, places = zip(*again, strict=True)
                    copies = features[list(places)]
                    yield self._write(equals, copies, self._environment, "repeated")

    def _cameras_of(self, piece: Piece) -> Mapping[str, CameraStream]:
        """Opened once an episode, for the next ranges are of the same."""
        with self._cameras_turn:
            if piece.episode not in self._cameras:
                if len(self._cameras) == _OPEN_EPISODES:
                    del self._cameras[next(iter(self._cameras))]
                self._cameras[piece.episode] = piece.recording.cameras()
            return self._cameras[piece.episode]

    def _write(
        self,
        rows: Sequence[KnownRow | ReadyRow],
        features: NDArray[Any],
        environment: Mapping[str, Any],
        came: Came,
    ) -> WrittenRows:
        numbers = np.array([one.row for one in rows], np.int64)
        with self._disk_turn:
            if self._closed:
                raise StoreIncomplete(f"{self._job.name} has ended; its rows are nobody's")
            checksums = self._build.write_features(numbers, features)
        return WrittenRows(numbers, [one.key for one in rows], checksums, environment, came)

    def _loaded(self) -> Encoder:
        if self._encoder is None:
            params, spec = self._job.params, self._job.spec
            device = device_of(params.extract.device, self._job.local, self._worker_name)
            vlm = FrozenVLM.load(params.vlm, spec, device, compile=params.extract.compile)
            self._encoder = Encoder(vlm, params.extract.batch_size, spec.variants)
            self._environment = vlm.environment
        return self._encoder


def device_of(wanted: str, local: bool, worker_name: object) -> str:
    """The device of a worker: local ones take turns over the GPUs, others use the first they see.

    As dask-cuda, and CUDA_VISIBLE_DEVICES, show each worker its own first.
    """
    devices = torch.cuda.device_count()
    if local and isinstance(worker_name, int) and wanted in ("auto", "cuda") and devices > 1:
        return f"cuda:{worker_name % devices}"
    return wanted


def check_place(job: Job) -> None:
    """Raise where this worker does not see the files that the coordinator sees, or not the same."""
    here, host = Path.cwd(), socket.gethostname()
    if not job.folder.is_dir() or not here.samefile(job.folder):
        raise ConfigError(
            f"the worker on {host} runs in {here}, the coordinator in {job.folder}: relative paths "
            f"would not be the same. Start every worker with `cd {job.folder}`, on a file system "
            "that all hosts share."
        )
    part = part_path(job.target)
    if read_plan(part) != job.plan:
        raise StoreIncomplete(
            f"the worker on {host} does not see the build {part}. Workers on other hosts need a "
            "file system that all hosts share: set extract.store to a folder of one."
        )
    if not job.local:
        vlm, dtype = job.params.vlm, job.params.extract.dtype
        found = feature_spec(vlm, dtype, job.spec.views, file_digest)
        if found.digest != job.spec.digest:
            lines = "; ".join(describe(differences(found.attrs(), job.spec.attrs())))
            raise ConfigError(
                f"the worker on {host} would compute other features than the coordinator asks "
                f"for: {lines}. Give it the same checkpoint and the same version of this package."
            )
