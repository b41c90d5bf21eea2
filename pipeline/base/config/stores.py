"""Sections for work on stores: check, archive, probe, and tidy."""

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
    """What is checked in a store."""

    store: Place | None = None
    """`extract.store` where null."""
    reextract: int = Field(default=0, ge=0, le=10**9)
    """Number of random rows to compute again with today's software and hardware."""
    tolerance: float | None = Field(default=None, gt=0, le=1e3)
    """Largest deviation of a recomputed row, relative to the root mean square of its slot; null: a
    value that fits the dtypes in which the row was computed and stored."""
    seed: Seed = 0
    """Seed of the choice of rows."""
    repair: bool = False
    """Begin a new build without the damaged parts; stages.extract completes it."""
    checkpoint: Place | Literal[True] | None = None
    """Instead of a store, check that the model of `vlm` computes the features that this checkpoint
    was trained on; true: the checkpoint in `train_head.output`."""
    threads: int = Field(default=4, ge=1, le=256)
    """Threads of this process that read and check."""
    workers: Workers = 0
    """0: this process; N: local processes; or the address of a dask scheduler."""


class ArchiveParams(Section):
    """The archive: a compressed copy of a store, to keep and share."""

    store: Place | None = None
    """`extract.store` where null."""
    output: Output | None = None
    """The archive; null: `<name>.archive.zarr` beside the store."""
    restore: bool = False
    """Instead make the store from the archive, bit for bit."""
    level: int = Field(default=5, ge=1, le=22)
    """Level of zstd: higher is smaller and slower to write."""
    threads: int = Field(default=4, ge=1, le=256)
    """Threads that compress or decompress."""


class ProbeParams(Section):
    """How slots are ranked by how well a linear model predicts actions from them."""

    store: Place | None = None
    """`extract.store` where null."""
    horizon: int = Field(default=8, ge=1, le=1000)
    """Ticks of the action chunk that is predicted."""
    folds: int = Field(default=5, ge=2, le=1000)
    """Groups of recordings, each held out once per repeat."""
    repeats: int = Field(default=3, ge=1, le=1000)
    """How often the recordings are dealt into folds; an interval covers this choice too."""
    penalties: tuple[Annotated[float, Field(gt=0, le=1e12)], ...] = Field(
        default=(1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0), min_length=1, max_length=100
    )
    """Ridge penalties per row, for standardised inputs; each fold uses the best one on the other
    folds."""
    max_ticks: int | None = Field(default=20_000, ge=1, le=10**9)
    """Most ticks used, evenly spread over all episodes; null uses all. Memory grows with it."""
    sensor_window: int = Field(default=65, ge=1, le=20_000)
    """Sensor readings before the tick; their mean, last value and spread are the inputs."""
    state_window: int = Field(default=100, ge=1, le=20_000)
    """State readings before the tick, used in the same way."""
    threads: int = Field(default=2, ge=1, le=256)
    """Threads, each of which works on its own slot."""
    check_store: bool = True
    """First read the whole store, and refuse a chunk that does not give its checksum; false skips
    this, where it takes too long."""
    output: Output = Path("reports/probe")
    """Folder of the table and the picture."""


class PushParams(Section):
    """Which policy or store is uploaded to the Hugging Face Hub, and where to."""

    repo: str = ""
    """The repository, as owner/name. It is made if there is none."""
    folder: Place | None = None
    """A trained policy, a finished store or an archive. null: `train_head.output`."""
    private: bool = True
    """Whether a new repository is private. A policy carries a few camera frames (golden rows), a
    store all streams: look at them before you publish."""
    card_only: bool = False
    """Print the card and the list of files, and upload nothing."""


class StoresParams(Section):
    """Housekeeping among the stores of a folder."""

    action: Literal["list", "merge", "gc"] = "list"
    """list: print the stores. merge: make one store of several. gc: remove what nothing needs."""
    folder: Place = Path("cache_store")
    """Folder of the stores."""
    checkpoints: tuple[Place, ...] = (Path("models"),)
    """Folders of trained policies, each of which names the store that it was trained on."""
    inputs: tuple[Place, ...] = ()
    """For `merge`: the stores that become one. For `gc`: only these entries."""
    output: Output | None = None
    """For `merge`: the new store."""
    remove: bool = False
    """For `gc`: remove what it lists; false only lists it."""
