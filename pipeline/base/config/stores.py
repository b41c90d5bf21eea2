"""Sections of what is done with stores: check, keep, compare their slots, tidy."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from pipeline.base.config.section import Output, Place, Section, Seed


def _workers(value: Any) -> Any:
    if type(value) is int and 0 <= value <= 1024:
        return value
    if isinstance(value, str) and re.fullmatch(r"[a-z]+://.{1,300}", value):
        return value
    raise ValueError(
        "expected a number of processes up to 1024, or an address such as tcp://host:8786"
    )


Workers = Annotated[int | str, BeforeValidator(_workers)]
"""0: this process; N: local processes; or the address of a dask scheduler."""


class VerifyParams(Section):
    """What is checked of a store."""

    store: Place | None = None
    """`extract.store` where null."""
    reextract: int = Field(default=0, ge=0, le=10**9)
    """Random rows that are computed again with today's software and hardware."""
    tolerance: float | None = Field(default=None, gt=0, le=1e3)
    """Largest deviation of a recomputed row, relative to the root mean square of its slot; null
    goes by the dtypes that it was computed and stored in."""
    seed: Seed = 0
    """Of the choice of rows."""
    repair: bool = False
    """Begin a new build without what is damaged, for stages.extract to complete."""
    checkpoint: Place | Literal[True] | None = None
    """Prove in place of checking a store that the model of `vlm` gives the features that this
    checkpoint was trained on; true: that of `train_head.output`."""
    threads: int = Field(default=4, ge=1, le=256)
    """That read and check at a time in this process."""
    workers: Workers = 0
    """0: this process; N: local processes; or the address of a dask scheduler."""


class ArchiveParams(Section):
    """Where the copy for keeping and sharing lies."""

    store: Place | None = None
    """`extract.store` where null."""
    output: Output | None = None
    """The archive; `<name>.archive.zarr` beside the store where null."""
    restore: bool = False
    """Make the store from the archive, bit for bit, instead."""
    level: int = Field(default=5, ge=1, le=22)
    """Of zstd: higher is smaller and slower to write."""
    threads: int = Field(default=4, ge=1, le=256)
    """That compress or decompress at a time."""


class ProbeParams(Section):
    """How slots are ranked by what a linear reader finds in them."""

    store: Place | None = None
    """`extract.store` where null."""
    horizon: int = Field(default=8, ge=1, le=1000)
    """Ticks of the action chunk that is read out."""
    folds: int = Field(default=5, ge=2, le=1000)
    """Groups of recordings, each held out once in each deal."""
    repeats: int = Field(default=3, ge=1, le=1000)
    """Deals of the folds: what an interval covers beside the choice of recordings."""
    penalties: tuple[Annotated[float, Field(gt=0, le=1e12)], ...] = Field(
        default=(1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0), min_length=1, max_length=100
    )
    """Ridge penalties a row, of standardised inputs; each fold takes the one that is best
    on the other folds."""
    max_ticks: int | None = Field(default=20_000, ge=1, le=10**9)
    """Ticks used at most, evenly spread over all episodes; null uses all. Memory grows with it."""
    sensor_window: int = Field(default=65, ge=1, le=20_000)
    """Readings before the tick, of which the mean, the last and the spread are read."""
    state_window: int = Field(default=100, ge=1, le=20_000)
    """Readings before the tick, likewise."""
    threads: int = Field(default=2, ge=1, le=256)
    """That work at a time, each on a slot of its own."""
    check_store: bool = True
    """Read the store once before, and refuse a chunk that does not give its checksum; false where
    that takes too long."""
    output: Output = Path("reports/probe")
    """Folder of the table and the picture."""


class StoresParams(Section):
    """Housekeeping among the stores of a folder."""

    action: Literal["list", "merge", "gc"] = "list"
    """Say what is there, make one store of several, or remove what nothing needs."""
    folder: Place = Path("cache_store")
    """Where the stores are."""
    checkpoints: tuple[Place, ...] = (Path("models"),)
    """Folders of trained policies, which say what store they were trained on."""
    inputs: tuple[Place, ...] = ()
    """Of `merge`: the stores that become one."""
    output: Output | None = None
    """Of `merge`: the new store."""
    remove: bool = False
    """Of `gc`: remove what is listed; else it is only listed."""
