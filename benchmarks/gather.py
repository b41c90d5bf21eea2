"""How fast batches come out of a store, beside memory itself and beside other formats.

A store of 200,000 VL rows (2,048 x float16) and 2 GB of sensor readings (1,026 x float32) is built
in a scratch folder with the project's writer and gathered from with one thread, warm, in rounds
that every contender shares. The ceiling is a row gather in C from a copy of the array in RAM: the
faster of `numpy.take(mode="clip")` and `torch.index_select`, both into a reused buffer; of a whole
batch, those of its four wide fields one after the other, from indices that are there already.

Last come rows by what they keep (`SLOTS`), each in a store of its own (`--slots`: nothing else).

Before each of its turns a fast contender makes all its draws once, off the clock. A kernel that
looks for idle pages (reclaim, DAMON) marks those of files as unused, but not those of RAM without
swap; the processor sets each mark again at the next touch, which is not the gather's own time.
"""

import argparse
import gc
import itertools
import shutil
import statistics
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.contests import (
    CEILINGS,
    OURS,
    OURS_2,
    batch_race,
    draws,
    row_race,
    slot_race,
    window_race,
)
from benchmarks.loading import stream_rates
from benchmarks.stores import evict, write_store
from benchmarks.timing import Race, Work, arguments, at_least, at_most, race, report
from pipeline.store import FeatureStore
from pipeline.store import gather as gathering
from pipeline.store.memory_map import populate

FULL = {
    "episodes": 40,
    "ticks": 15_000,
    "readings": 12_200,
    "states": 15_000,
    "files": 20_000,
    "draws": 400,
    "readings_drawn": 200_000,
    "rows": 256,
    "windows": 64,
    "lengths": (65, 650),
    "least_s": 0.05,
    "long_store": 1_000_000,
}
QUICK = FULL | {
    "episodes": 2,
    "ticks": 2_100,
    "readings": 1_500,
    "states": 2_100,
    "files": 300,
    "draws": 8,
    "readings_drawn": 150,
    "windows": 4,
    "lengths": (13,),
    "least_s": 0.001,
    "long_store": 20_000,
}
SLOTS: dict[str, tuple[int, int, str]] = {
    "mean": (1, 128, "float32"),
    "grid 2x2": (12, 128, "float32"),
    "mean, grid": (49, 128, "float32"),
    "mean, grid in int8": (49, 128, "int8"),
    "mean, grid in pca 32, int8": (49, 32, "int8"),
    "tokens": (72, 128, "float32"),
    "tokens in int8": (72, 128, "int8"),
    "tokens of two layers": (144, 128, "float32"),
    "grid 8x8": (192, 128, "float32"),
}
"""Slots of the demo's three views, the numbers of one, and their dtype."""
_FEATURE_BYTES = 320_000_000
"""Of each store's codes: more than a cache holds."""
_NARROW: dict[str, Any] = {"readings": 200, "states": 200, "channels": 16}
_EPISODES = 40


def main() -> None:
    """Build, measure, print, clean up."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--slots", action="store_true", help="only rows by what they keep")
    parser.add_argument("--folder", type=Path, default=None, help="scratch; a temporary one")
    options = parser.parse_args()
    sizes: dict[str, Any] = QUICK if options.quick else FULL
    folder = Path(tempfile.mkdtemp(prefix="gather-", dir=options.folder))
    try:
        torch.set_num_threads(1)
        results, ratios, targets = (slots if options.slots else measure)(folder, sizes, options)
    finally:
        shutil.rmtree(folder)
    report(
        "gather",
        settings=({"rows": sizes["rows"]} if options.slots else sizes)
        | {"slots": SLOTS, "feature_bytes": _FEATURE_BYTES}
        | {"baseline": "the faster ceiling", "cold": COLD},
        results=results,
        ratios=ratios,
        targets=targets,
        quick=options.quick,
    )


COLD = (
    "pages of the files dropped with posix_fadvise(DONTNEED) before each call and the store mapped "
    "anew; what lies below the operating system (a host's cache) is not"
)


def measure(
    folder: Path, sizes: Mapping[str, Any], options: argparse.Namespace
) -> tuple[dict[str, Any], dict[str, Any], list[dict[str, Any]]]:
    """All parts of the benchmark, one after the other."""
    streams = {name: sizes[name] for name in ("episodes", "ticks", "readings", "states")}
    path = write_store(folder / "bench.zarr", **streams)
    rounds = options.rounds or (2 if options.quick else 15)
    slow = min(rounds, 3)
    store = FeatureStore.open(path)
    results: dict[str, Any] = {}
    ratios: dict[str, Any] = {}
    targets: list[dict[str, Any]] = []

    def add(part: str, found: Race, amount: Mapping[str, float]) -> str:
        ceiling = min(CEILINGS, key=found.median)
        results[part] = found.results(amount)
        ratios[part] = {"baseline": ceiling, **found.ratios(ceiling)}
        return ceiling

    rows, slow_rows = row_race(store, folder / "rows", sizes, rounds, slow)
    count = sizes["rows"]
    features = store.gatherer.tensor("features")
    amount = {
        "rows": count,
        "GB": count * features.nbytes / len(features) / 1e9,
    }
    for written in (folder / "rows").glob("rows.*"):
        written.unlink()
    targets.append(against_ceiling("rows", rows, add("rows", rows, amount), 0.95))
    results["rows, slow ways"] = slow_rows.results(amount)
    ratios["rows, slow ways"] = {"baseline": OURS, **slow_rows.ratios(OURS)}
    for ours, wanted in ((OURS, 200), (OURS_2, 300)):
        speedup = slow_rows.speed(ours, ".pt a sample")
        targets.append(at_least(f"rows: {ours}: times as fast as .pt files", speedup, wanted))
    for length in sizes["lengths"]:
        part = f"windows of {length}"
        warm, slower = window_race(store, folder / "windows", sizes, length, rounds, slow)
        amount = {"windows": sizes["windows"], "GB": sizes["windows"] * length * 4104 / 1e9}
        targets.append(against_ceiling(part, warm, add(part, warm, amount), 0.95))
        results[f"{part}, slow ways"] = slower.results(amount)
        ratios[f"{part}, slow ways"] = {"baseline": OURS, **slower.ratios(OURS)}
        part = f"batch of {sizes['windows']}, windows of {length}"
        whole = batch_race(store, sizes["windows"], length, sizes, rounds)
        targets.append(against_ceiling(part, whole, add(part, whole, {}), 0.9))
    part = f"batch of {count}, windows of {sizes['lengths'][0]}"
    whole = batch_race(store, count, sizes["lengths"][0], sizes, rounds)
    targets.append(against_ceiling(part, whole, add(part, whole, {}), 0.9))
    results["stream"] = stream_rates(store, sizes["lengths"][0], 12 if options.quick else 60)
    shutil.rmtree(folder / "windows")
    del store
    gc.collect()
    results["cold"] = cold(path, folder / "rows", sizes, slow)
    opened = open_race(path, folder, sizes["long_store"], rounds, sizes["least_s"])
    results["open"] = opened.results()
    ratio = statistics.median(
        long / short
        for long, short in zip(opened.seconds["long"], opened.seconds["10 k ticks"], strict=True)
    )
    targets.append(at_most(f"open {sizes['long_store']} ticks / 10 k ticks", ratio, 2))
    of_slots = slots(folder, sizes, options)
    return results | of_slots[0], ratios | of_slots[1], targets + of_slots[2]


def slots(
    folder: Path, sizes: Mapping[str, Any], options: argparse.Namespace
) -> tuple[dict[str, Any], dict[str, Any], list[dict[str, Any]]]:
    """Rows of each way to keep features, against C gathers of as many bytes."""
    results: dict[str, Any] = {}
    ratios: dict[str, Any] = {}
    targets: list[dict[str, Any]] = []
    for name in ["mean, grid in int8"] if options.quick else SLOTS:
        count, dim, dtype = SLOTS[name]
        rows = _FEATURE_BYTES // (count * dim * (1 if dtype == "int8" else 4))
        path = write_store(
            folder / "slots.zarr",
            **_NARROW,
            episodes=_EPISODES,
            reuse=1,
            slots=count,
            dim=dim,
            dtype=dtype,
            ticks=300 if options.quick else rows // _EPISODES,
        )
        store = FeatureStore.open(path)
        found = slot_race(store, sizes, options.rounds or (2 if options.quick else 15))
        ceiling, part = min(CEILINGS, key=found.median), f"rows of {name}"
        row_bytes = store.array("vl/features")[:1].nbytes
        amount = {"rows": sizes["rows"], "GB": sizes["rows"] * row_bytes / 1e9}
        results[part] = found.results(amount)
        ratios[part] = {"baseline": ceiling, **found.ratios(ceiling)}
        targets.append(against_ceiling(part, found, ceiling, 0.9))
        del store
        shutil.rmtree(path)
    return results, ratios, targets


def against_ceiling(part: str, found: Race, ceiling: str, wanted: float) -> dict[str, Any]:
    """The target of a part: its speed as a share of the ceiling's."""
    return at_least(f"{part}: share of {ceiling}", found.speed(OURS, ceiling), wanted)


class Fresh:
    """A store that is opened anew, with nothing of its files in the page cache, for each call."""

    def __init__(self, path: Path, available: int | None = None) -> None:
        self._path, self._available = path, available
        self.store: FeatureStore | None = None

    def prepare(self) -> None:
        """Let go of the last one, drop its pages, map it again."""
        self.store = None
        gc.collect()
        evict(self._path)
        real = gathering.available_bytes
        try:
            if self._available is not None:
                gathering.available_bytes = lambda: self._available
            self.store = FeatureStore.open(self._path)
            self.store.gatherer.empty_batch(1, 1, 1, 1)  # here it decides how to page
        finally:
            gathering.available_bytes = real

    def gather(self, ticks: NDArray[np.int64], window: int) -> None:
        """One batch."""
        assert self.store is not None
        self.store.gather(ticks, 8, window, 100)

    def populate(self) -> None:
        """All wide streams, in order."""
        assert self.store is not None
        for name in gathering.WIDE.values():
            populate(self.store.array(name))


def cold(path: Path, rows: Path, sizes: Mapping[str, Any], rounds: int) -> dict[str, Any]:
    """A first batch from a store that is not in memory, and from sample files that are not."""
    fits, larger = Fresh(path), Fresh(path, available=0)
    ticks = draws(64, sizes["rows"], 0, sizes["episodes"] * sizes["ticks"])
    files = draws(64, sizes["rows"], 0, sizes["files"])
    kept = {int(file.stem) for file in (rows / "files").glob("*.pt")}
    order, file_order = itertools.cycle(ticks), itertools.cycle(files)

    def pt() -> None:
        for row in next(file_order).tolist():
            if row in kept:
                torch.load(rows / "files" / f"{row}.pt")

    contenders: dict[str, Work] = {
        "batch of rows, store as one that fits": lambda: fits.gather(next(order), 1),
        "batch of rows, store as one larger than memory": lambda: larger.gather(next(order), 1),
        "batch of windows, store as one that fits": lambda: fits.gather(next(order), 65),
        "batch of windows, store as one larger than memory": lambda: larger.gather(next(order), 65),
        "populate the whole store": fits.populate,
        ".pt a sample": pt,
    }
    before = {
        name: fits.prepare if "fits" in name or "populate" in name else larger.prepare
        for name in contenders
    }
    before[".pt a sample"] = lambda: evict(rows / "files")
    found = race(contenders, rounds, warmup=0, before=before)
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    results: dict[str, Any] = found.results()
    results["populate the whole store"]["GB_per_s"] = (
        size / 1e9 / found.median("populate the whole store")
    )
    return results


def open_race(path: Path, folder: Path, long_store: int, rounds: int, least_s: float) -> Race:
    """Opening: a short store, a long one of the same kind, and the large one of this benchmark."""
    short = write_store(folder / "short.zarr", episodes=50, ticks=200, dim=64, **_NARROW)
    episodes = long_store // 200
    long = write_store(folder / "long.zarr", episodes=episodes, ticks=200, dim=64, **_NARROW)

    def first_batch(store: Path) -> Work:
        return lambda: FeatureStore.open(store).gather(np.arange(64))

    contenders: dict[str, Work] = {
        "10 k ticks": lambda: FeatureStore.open(short),
        "long": lambda: FeatureStore.open(long),
        "wide": lambda: FeatureStore.open(path),
        "10 k ticks, and a batch": first_batch(short),
        "long, and a batch": first_batch(long),
    }
    return race(contenders, rounds, least_s=least_s)


if __name__ == "__main__":
    main()
