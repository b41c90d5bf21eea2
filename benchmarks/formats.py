"""The same rows in the formats that people keep them in, and one way each to read a batch."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask
import dask.array
import h5py
import lmdb
import numpy as np
import tensorstore
import torch
import zarr
from numpy.typing import NDArray
from tqdm import tqdm

Rows = NDArray[np.int64]
Read = Callable[[Rows], object]
"""Reads the rows of this index, in its order, into one array."""


def row_readers(folder: Path, store: Path, name: str, values: NDArray[Any]) -> dict[str, Read]:
    """Readers of rows of `values` (row, …), which the store at `store` has under `name`.

    What is not the store's own file is written below `folder` first.
    """
    contiguous, memmap = _one_file(folder / "rows.h5", values)
    array = zarr.open_array(store, path=name, mode="r")
    lazy = dask.array.from_zarr(array)
    cached = _tensorstore(store / name)

    def from_h5py(rows: Rows) -> object:
        distinct, back = np.unique(rows, return_inverse=True)  # it takes ascending indices only
        return contiguous[distinct][back]

    def from_dask(rows: Rows) -> object:
        with dask.config.set(scheduler="threads"):
            return lazy[rows].compute()

    return {
        "numpy memmap, fancy index": lambda rows: np.asarray(memmap[rows]),
        "h5py, contiguous": from_h5py,
        "lmdb": _lmdb(folder, values),
        "tensorstore, cache in RAM": lambda rows: cached[rows].read().result(),
        "zarr oindex": lambda rows: array.oindex[rows],
        "dask": from_dask,
    }


def window_readers(
    folder: Path, store: Path, name: str, values: NDArray[Any], length: int
) -> dict[str, Read]:
    """Readers of the windows of `length` readings that end before these, one way each."""
    contiguous, memmap = _one_file(folder / "readings.h5", values)
    array = zarr.open_array(store, path=name, mode="r")
    lazy = dask.array.from_zarr(array)
    cached = _tensorstore(store / name)
    place = np.arange(-length, 0)

    def flat(ends: Rows) -> Rows:
        return (ends[:, None] + place).ravel()

    def from_dask(ends: Rows) -> object:
        with dask.config.set(scheduler="threads"):
            return dask.array.concatenate([lazy[e - length : e] for e in ends]).compute()

    return {
        "numpy memmap, fancy index": lambda ends: np.asarray(memmap[flat(ends)]),
        "h5py, contiguous": lambda ends: np.stack([contiguous[e - length : e] for e in ends]),
        "tensorstore, cache in RAM": lambda ends: cached[flat(ends)].read().result(),
        "zarr oindex": lambda ends: array.oindex[flat(ends)],
        "dask": from_dask,
    }


def file_readers(folder: Path, samples: NDArray[Any]) -> dict[str, Read]:
    """Readers of `samples` (sample, …), each kept in a file of its own."""
    folder.mkdir()
    for index in tqdm(range(len(samples)), desc="files", disable=None):
        np.save(folder / f"{index}.npy", samples[index])
        torch.save(torch.from_numpy(samples[index]), folder / f"{index}.pt")

    def npy(rows: Rows) -> object:
        return np.stack([np.load(folder / f"{row}.npy") for row in rows])

    def pt(rows: Rows) -> object:
        return torch.stack([torch.load(folder / f"{row}.pt") for row in rows])

    return {".npy a sample": npy, ".pt a sample": pt}


def _one_file(path: Path, values: NDArray[Any]) -> tuple[Any, NDArray[Any]]:
    """The values in one contiguous file, as h5py reads it and as numpy maps it."""
    if not path.exists():
        with h5py.File(path, "w") as file:
            file["rows"] = values
    rows = h5py.File(path, "r")["rows"]
    return rows, np.memmap(path, values.dtype, "r", rows.id.get_offset(), values.shape)


def _lmdb(folder: Path, values: NDArray[Any]) -> Read:
    size = 4 * values.nbytes + 2**24
    environment = lmdb.open(str(folder / "rows.lmdb"), map_size=size, subdir=False, lock=False)
    with environment.begin(write=True) as writing:
        for index, row in enumerate(values):
            writing.put(index.to_bytes(8, "big"), row.tobytes(), append=True)
    shape, dtype = values.shape[1:], values.dtype

    def read(rows: Rows) -> object:
        out = np.empty((len(rows), *shape), dtype)
        with environment.begin(buffers=True) as reading:
            for index, row in enumerate(rows.tolist()):
                found = reading.get(row.to_bytes(8, "big"))
                assert found is not None, row
                out[index] = np.frombuffer(found, dtype).reshape(shape)
        return out

    return read


def _tensorstore(array: Path) -> Any:
    return tensorstore.open(
        {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(array)},
            "context": {"cache_pool": {"total_bytes_limit": 8 * 2**30}},
            "recheck_cached_data": "open",
        },
        read=True,
    ).result()
