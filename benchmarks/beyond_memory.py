"""Training on a store of tokens larger than memory: its memory, and steps/s against a store in RAM.

    python -m benchmarks.beyond_memory [--rows N] [--memory-gb GB] [--folder PATH]

The default head with `feature_encoder: {kind: pooler}` reads the 299 tokens that the 3B model makes
of a view of 360 x 640, in float16. Memory counts as `--memory-gb`, so the store's features do not
fit, and what the kernel kept of them is dropped before each round: each row comes from the disk.
Memory is what the process holds for itself (anonymous pages); pages of files are the kernel's to
drop. For a limit that the kernel enforces, run it under `systemd-run --scope -p MemoryMax=4G`.
"""

import ctypes
import mmap
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks.stores import evict, write_store
from benchmarks.timing import Work, arguments, at_least, at_most, race, report
from benchmarks.train_step import SMALL, Contender
from pipeline.base.config import TrainHeadParams, load_params
from pipeline.store import FeatureStore
from pipeline.train.batches import Prefetch, Windows
from pipeline.train.loop import Trainer
from pipeline.train.run import TrainingRun
from pipeline.train.split import split_by_episode

DISK, RAM = "larger than memory", "in RAM"
FEATURES = "vl/features"
FULL: dict[str, Any] = {"tokens": (13, 23), "dim": 2048, "ticks": 600}
QUICK: dict[str, Any] = {"tokens": (2, 2), "dim": 16, "ticks": 60}
ROWS_IN_RAM = 400
READER = {"feature_encoder": {"kind": "pooler"}}
_REUSE, _CHANNELS = 3, 16
_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
_ENDLESS = range(10**9)


class AnonymousMemory:
    """How many more bytes the process holds for itself than at the begin of a phase, at most."""

    def __init__(self) -> None:
        self.grown: dict[str, int] = {}

    @contextmanager
    def of(self, phase: str) -> Generator[None]:
        """Sample every 20 ms within."""
        before, over = _anonymous_bytes(), threading.Event()
        self.grown[phase] = 0

        def sample() -> None:
            while not over.wait(0.02):
                self.grown[phase] = max(self.grown[phase], _anonymous_bytes() - before)

        thread = threading.Thread(target=sample, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def main() -> None:
    """Build, train, print, clean up."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--rows", type=int, default=8000, help="VL rows of the larger store")
    parser.add_argument("--memory-gb", type=float, default=4.0, help="memory that counts as there")
    parser.add_argument("--steps", type=int, default=10, help="steps of a round")
    parser.add_argument("--folder", type=Path, default=None, help="scratch; a temporary one")
    options = parser.parse_args()
    quick: bool = options.quick
    rows = {DISK: 200, RAM: 60} if quick else {DISK: options.rows, RAM: ROWS_IN_RAM}
    memory = 20_000 if quick else int(1e9 * options.memory_gb)
    steps, rounds = (1, 2) if quick else (options.steps, options.rounds or 5)
    sizes = QUICK if quick else FULL
    folder = Path(tempfile.mkdtemp(prefix="beyond-memory-", dir=options.folder))
    try:
        paths = {name: _write(folder / name, sizes, count) for name, count in rows.items()}
        with patch("pipeline.store.gather.available_bytes", lambda: memory):
            measured = measure(paths, steps, rounds, quick)
    finally:
        shutil.rmtree(folder)
    settings = {**sizes, **READER, "rows": rows, "steps": steps, "memory_GB": memory / 1e9}
    report("beyond_memory", settings=settings, quick=quick, **measured)


def measure(paths: dict[str, Path], steps: int, rounds: int, quick: bool) -> dict[str, Any]:
    """What a training of each store holds and waits for."""
    memory = AnonymousMemory()
    stores = {name: FeatureStore.open(path) for name, path in paths.items()}
    _drop(stores[DISK])
    begun = time.perf_counter()
    with memory.of("normalisation"):
        trainers = {DISK: _trainer(stores[DISK], quick)}
    fitted_s = time.perf_counter() - begun
    with ExitStack() as stack:
        with memory.of("training"):
            contenders = {DISK: _contender(trainers[DISK], steps, stack)}
            for _ in range(rounds):
                contenders[DISK].run()
        trainers[RAM] = _trainer(stores[RAM], quick)
        contenders[RAM] = _contender(trainers[RAM], steps, stack)
        assert "features" in stores[RAM].gatherer.in_memory
        assert "features" not in stores[DISK].gatherer.in_memory
        stores[RAM].gatherer.populate()
        work: dict[str, Work] = {name: one.run for name, one in contenders.items()}
        found = race(work, rounds, before={DISK: lambda: _drop(stores[DISK])})
    step_bytes = steps * trainers[DISK].params.batch_size * stores[DISK].array(FEATURES)[0].nbytes
    results: dict[str, Any] = found.results({"steps": steps, "GB": step_bytes / 1e9})
    for name, store in stores.items():
        shares = contenders[name].wait_shares[-rounds:]
        results[name] |= {"wait_share": statistics.median(shares)}
        results[name] |= {"features_GB": store.array(FEATURES).nbytes / 1e9}
    results[DISK] |= {"normalisation_s": fitted_s}
    results[DISK] |= {f"{phase}_holds_GB": n / 1e9 for phase, n in memory.grown.items()}
    speed = found.speed(DISK, RAM)
    return {
        "results": results,
        "ratios": {DISK: speed},
        "targets": [
            at_most("GB that a training holds for itself", max(memory.grown.values()) / 1e9, 2.0),
            at_least("steps/s against a store in RAM", speed, 0.5),
        ],
    }


def _write(folder: Path, sizes: dict[str, Any], rows: int) -> Path:
    ticks = sizes["ticks"]
    return write_store(
        folder / "tokens.zarr",
        episodes=-(-rows * _REUSE // ticks),
        reuse=_REUSE,
        readings=8 * ticks,
        states=2 * ticks,
        channels=_CHANNELS,
        **sizes,
    )


def _trainer(store: FeatureStore, quick: bool) -> Trainer:
    folder = store.path.parent
    changed = {"output": folder / "head", "logs": folder / "logs", "device": "cpu", **READER}
    given = load_params(Path("params.yaml")).train_head.model_dump()
    params = TrainHeadParams.model_validate(given | changed | (SMALL if quick else {}))
    split = split_by_episode(store, params.split, params.horizon)
    return Trainer(store, params, split, TrainingRun(params.output, "new", (), {}))


def _contender(trainer: Trainer, steps: int, stack: ExitStack) -> Contender:
    parts, windows = trainer.plan.parts_of(_ENDLESS), Windows.of(trainer.params)
    feed = stack.enter_context(Prefetch(trainer.store, parts, windows, trainer.device))
    return Contender(trainer, feed, steps)


def _drop(store: FeatureStore) -> None:
    """Take the features out of memory: first from the map, then from the kernel's cache."""
    features = store.array(FEATURES)
    if _LIBC.madvise(features.ctypes.data, features.nbytes, mmap.MADV_DONTNEED):
        raise OSError(ctypes.get_errno(), "madvise")
    evict(store.path / FEATURES)


def _anonymous_bytes() -> int:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("RssAnon"))
    return int(line.split()[1]) * 1024


if __name__ == "__main__":
    main()
