"""The store against memory and against other formats: rows, windows and whole batches."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.formats import file_readers, row_readers, window_readers
from benchmarks.timing import Race, Work, race
from pipeline.store import FeatureStore
from pipeline.store.gather import WIDE, Selection, Window
from pipeline.store.memory_map import populate

Index = NDArray[np.int64]
CEILINGS = ("C gather from RAM: numpy take", "C gather from RAM: torch index_select")
OURS, OURS_2 = "store, 1 thread", "store, 2 threads"


def row_race(
    store: FeatureStore, folder: Path, sizes: Mapping[str, Any], rounds: int, slow: int
) -> tuple[Race, Race]:
    """256 random VL rows: the fast ways, then the slow ones beside the store again."""
    folder.mkdir()
    count, (ram, out, drawn, ways) = sizes["rows"], row_ways(store, sizes)
    fast: dict[str, Work] = {
        "memcpy": each(drawn, lambda rows: out.copy_(ram[rows[0] % (len(ram) - count) :][:count])),
        **ways,
        OURS_2: two_threads(ways[OURS]),
    }
    values = store.array("vl/features")
    few = draws(sizes["draws"], count, 0, min(sizes["files"], len(ram)))
    files = file_readers(folder / "files", values[: sizes["files"]])
    readers = row_readers(folder, store.path, "vl/features", values)
    fast |= {name: each(drawn, readers.pop(name)) for name in ("numpy memmap, fancy index",)}
    slower = {name: each(drawn, read) for name, read in readers.items()}
    slower |= {name: each(few, read) for name, read in files.items()}
    warm(store)
    return (
        race(fast, rounds, least_s=sizes["least_s"], before=all_drawn(fast, len(drawn))),
        race({**{name: fast[name] for name in (OURS, OURS_2)}, **slower}, slow),
    )


def slot_race(store: FeatureStore, sizes: Mapping[str, Any], rounds: int) -> Race:
    """Random VL rows of a store, against C gathers of the same bytes from RAM."""
    *_, drawn, ways = row_ways(store, sizes)
    warm(store)
    return race(ways, rounds, least_s=sizes["least_s"], before=all_drawn(ways, len(drawn)))


def row_ways(
    store: FeatureStore, sizes: Mapping[str, Any]
) -> tuple[Tensor, Tensor, list[Index], dict[str, Work]]:
    """A copy of all rows in RAM, a buffer, random draws, and the ways to gather them."""
    count, mapped = sizes["rows"], store.gatherer.tensor("features")
    drawn = draws(sizes["draws"], count, 0, len(mapped))
    ram, out = mapped.clone(), torch.zeros((count, *mapped.shape[1:]), dtype=mapped.dtype)
    batch = store.gatherer.empty_batch(count, 1, 1, 1).touch()

    def ours(rows: Index) -> None:
        store.gatherer.copy(Selection({"features": rows}, {}), batch)

    return ram, out, drawn, ceilings(ram, out, drawn) | {OURS: each(drawn, ours)}


def window_race(
    store: FeatureStore,
    folder: Path,
    sizes: Mapping[str, Any],
    length: int,
    rounds: int,
    slow: int,
) -> tuple[Race, Race]:
    """64 random windows: the fast ways, then the slow ones beside the store again."""
    folder.mkdir(exist_ok=True)
    count, mapped = sizes["windows"], store.gatherer.tensor("sensor")
    ram = mapped.clone()
    drawn = draws(window_draws(sizes, count, length), count, length, len(mapped))
    batch = store.gatherer.empty_batch(count, 1, length, 1).touch()
    out, full = torch.zeros_like(batch.sensor), np.full(count, length)
    flat, place = out.view(-1, mapped.shape[1]), np.arange(-length, 0)
    by_row = [(ends[:, None] + place).ravel() for ends in drawn]
    other = torch.ones_like(out)

    def ours(ends: Index) -> None:
        store.gatherer.copy(Selection({}, {"sensor": Window(ends, full)}), batch)

    fast: dict[str, Work] = {
        "memcpy": lambda: out.copy_(other),
        **ceilings(ram, flat, by_row),
        OURS: each(drawn, ours),
        OURS_2: two_threads(each(drawn, ours)),
    }
    values = store.array("sensor/values")
    readers = window_readers(folder, store.path, "sensor/values", values, length)
    files = min(len(values) // length, 65_000 // length)
    samples = values[: files * length].reshape(files, length, -1)
    by_file = file_readers(folder / f"files {length}", samples)
    few = draws(len(drawn), count, 0, files)
    warm(store)
    slower = {name: each(drawn, read) for name, read in readers.items()}
    slower |= {name: each(few, read) for name, read in by_file.items()}
    return (
        race(fast, rounds, least_s=sizes["least_s"], before=all_drawn(fast, len(drawn))),
        race({OURS: each(drawn, ours), **slower}, slow),
    )


def batch_race(
    store: FeatureStore, count: int, length: int, sizes: Mapping[str, Any], rounds: int
) -> Race:
    """A whole `Batch` from its ticks, against its wide fields' rows gathered from RAM."""
    wanted = (8, length, 100)
    drawn = draws(window_draws(sizes, count, length), count, store.ticks // 8, store.ticks)
    out = store.gatherer.empty_batch(count, *wanted).touch()
    ram = {name: store.gatherer.tensor(name).clone() for name in WIDE}
    warm(store)
    bare = {name: torch.zeros_like(getattr(out, name)) for name in ram}
    rows = [wide_rows(store, ticks, wanted) for ticks in drawn]

    def from_ram(take: Callable[[torch.Tensor, Index, torch.Tensor], object]) -> Work:
        order = itertools.cycle(rows)
        return lambda: [
            take(ram[name], index, bare[name].view(-1, *ram[name].shape[1:]))
            for name, index in next(order).items()
        ]

    def ours(ticks: Index) -> None:
        store.gather(ticks, *wanted, out=out)

    contenders: dict[str, Work] = {
        CEILINGS[0]: from_ram(numpy_take),
        CEILINGS[1]: from_ram(torch_select),
        OURS: each(drawn, ours),
        OURS_2: two_threads(each(drawn, ours)),
    }
    return race(
        contenders,
        rounds,
        least_s=sizes["least_s"],
        before=all_drawn(contenders, len(drawn)),
    )


def warm(store: FeatureStore) -> None:
    """Bring back what writing other formats may have pushed out of memory."""
    for name in WIDE.values():
        populate(store.array(name))


def wide_rows(store: FeatureStore, ticks: Index, wanted: tuple[int, int, int]) -> dict[str, Index]:
    """The rows that the wide fields of a batch without padding are made of."""
    batch, any_age = (
        store.gatherer.empty_batch(len(ticks), *wanted),
        {"sensor": None, "state": None},
    )
    selection = store.gatherer.select(batch, ticks, 0, 0.0, 0.0, None, any_age)
    lengths = {"sensor": wanted[1], "state": wanted[2]}
    windows = {
        name: (window.end[:, None] + np.arange(-lengths[name], 0)).ravel()
        for name, window in selection.windows.items()
    }
    return {**selection.rows, **windows}


def ceilings(ram: Tensor, out: Tensor, drawn: Sequence[Index]) -> dict[str, Work]:
    """Both C gathers of these rows of an array in RAM into a buffer."""
    return {
        CEILINGS[0]: each(drawn, lambda rows: numpy_take(ram, rows, out)),
        CEILINGS[1]: each(drawn, lambda rows: torch_select(ram, rows, out)),
    }


def numpy_take(ram: Tensor, rows: Index, out: Tensor) -> None:
    """`mode="clip"` writes into the buffer; `raise` would gather into a copy of it."""
    np.take(ram.numpy(), rows, axis=0, out=out.numpy(), mode="clip")


def torch_select(ram: Tensor, rows: Index, out: Tensor) -> None:
    """One thread or several, as torch is set."""
    torch.index_select(ram, 0, torch.from_numpy(rows), out=out)


def draws(count: int, size: int, low: int, high: int) -> list[Index]:
    """Random indices, the same in every run: more of them than a cache holds."""
    rng = np.random.default_rng(0)
    return [rng.integers(low, high, size) for _ in range(count)]


def window_draws(sizes: Mapping[str, Any], count: int, length: int) -> int:
    """So many draws that together they read more than a cache holds."""
    return max(2, sizes["readings_drawn"] // (count * length))


def all_drawn(contenders: Mapping[str, Work], draws: int) -> dict[str, Work]:
    """Each contender's way to read all its draws once: what it does before its turn."""

    def through(work: Work) -> Work:
        return lambda: [work() for _ in range(draws)]

    return {name: through(work) for name, work in contenders.items()}


def each(drawn: Sequence[Index], read: Callable[[Index], object]) -> Work:
    """Read the next draw at each call, from the first again after the last."""
    order = itertools.cycle(drawn)
    return lambda: read(next(order))


def two_threads(work: Work) -> Work:
    """The same while torch has two threads."""

    def run() -> None:
        torch.set_num_threads(2)
        work()
        torch.set_num_threads(1)

    return run
