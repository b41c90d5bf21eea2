"""Sections for the demo, recordings, the frozen model, extraction, and work on stores."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from pipeline.base.config.section import Globs, Output, PathOrName, Place, Section, Seed
from pipeline.base.hub import could_be_hub_id

RecordingFormat = Literal["auto", "raw", "new", "old", "lerobot"]
PoolingName = Literal["mean", "image_mean", "text_mean", "view_mean", "grid", "tokens", "last"]
Dtype = Literal["float32", "float16", "bfloat16"]
StorageDtype = Literal["float32", "float16", "bfloat16", "float8", "int8"]
GridSide = Annotated[int, Field(ge=1, le=64)]
Layer = int | Literal["vision"]
"""Index of a decoder layer, or the vision tower."""


Layers = Annotated[
    Annotated[Literal["all"], Tag("all")]
    | Annotated[tuple[Layer, ...], Field(min_length=1, max_length=1000), Tag("some")],
    Discriminator(lambda value: "all" if isinstance(value, str) else "some"),
]
"""Some layers, or every decoder layer."""


class PCA(Section):
    """Fewer numbers a slot: its coefficients on the main directions of some of the features."""

    pca: int = Field(ge=1, le=65_536)
    """How many; at most the width of the model's hidden states."""
    then: StorageDtype = "int8"
    """The type in which they are stored."""
    basis: Place | None = None
    """A store whose directions are taken, so that the two can be merged, or a policy be judged on
    both; null: those of the store at `extract.store`, or new ones."""

    def __str__(self) -> str:
        return f"pca {self.pca} in {self.then}"


FeatureDtype = Annotated[
    Annotated[StorageDtype, Tag("name")] | Annotated[PCA, Tag("pca")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "pca"),
]


def stored_as(dtype: StorageDtype | PCA) -> StorageDtype:
    """The type of the numbers that are stored."""
    return dtype.then if isinstance(dtype, PCA) else dtype


class GridPooling(Section):
    """A grid of its own size, so that several stand side by side."""

    grid: tuple[GridSide, GridSide]
    """Rows and columns."""

    def __str__(self) -> str:
        return f"grid {self.grid[0]}x{self.grid[1]}"


Pooling = Annotated[
    Annotated[PoolingName, Tag("name")] | Annotated[GridPooling, Tag("size")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "size"),
]


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


class DemoParams(Section):
    """The simulated recordings and the small checkpoint that `stages.demo` writes."""

    recordings: Output = Path("data/demo")
    """Folder of the four sets of recordings."""
    checkpoint: Output = Path("models/demo_vlm")
    """Folder of a small Qwen2.5-VL with random weights."""
    episodes: int = Field(default=36, ge=2, le=10_000)
    """Episodes per format."""
    seed: Seed = 0
    """Seed of the simulation and of the checkpoint's weights."""


class MediaLimits(Section):
    """Limits of one file of a recording; a larger one is refused before memory is allocated."""

    pixels: int = Field(default=7680 * 4320, ge=1, le=10**12)
    """Most pixels (height x width) of one frame; by default 8K, which takes a second to decode."""
    array_bytes: int = Field(default=8 * 2**30, ge=1, le=2**50)
    """Most unpacked bytes of one array or table."""


class Source(Section):
    """One named set of recordings."""

    name: str = Field(min_length=1, max_length=200)
    """The source's name in `train_head.mixture` and in reports."""
    path: Globs | None = None
    """Globs or paths of episodes, folders of episodes, or LeRobot roots; relative to data.root."""
    hub: str | None = None
    """In place of `path`: a data set on the Hugging Face Hub, as owner/name or
    owner/name@revision."""
    format: RecordingFormat = "auto"
    """Format of the recordings; `auto` decides by the files in a folder."""
    instruction: str | None = None
    """Replaces the instruction in the recordings."""
    action_kind: Literal["auto", "absolute", "velocity", "delta"] = "auto"
    """Kind of the recorded actions; `auto` decides by format and channel names."""
    limits: MediaLimits = MediaLimits()

    @property
    def paths(self) -> tuple[str, ...]:
        """The globs as a tuple; none for a source on the Hub."""
        return (self.path,) if isinstance(self.path, str) else self.path or ()

    @model_validator(mode="after")
    def _is_somewhere(self) -> "Source":
        if (self.path is None) == (self.hub is None):
            both = "neither" if self.path is None else "both"
            raise ValueError(f"expected either path or hub, found {both}")
        if self.hub is not None:
            repo, at, revision = self.hub.partition("@")
            if not could_be_hub_id(repo) or bool(at) != bool(revision):
                raise ValueError(
                    f"hub: expected owner/name or owner/name@revision, found {self.hub!r}"
                )
        return self


class DataParams(Section):
    """The recordings, and how they become ticks."""

    root: Place = Path("data/demo")
    """Folder of recordings that DVC watches; it does not watch source paths outside it."""
    sources: tuple[Source, ...] = Field(min_length=1)
    """Sets of recordings of one embodiment: the same action, state and sensor channels."""
    action_hz: float | None = Field(default=10.0, gt=0, le=1e4)
    """Ticks per second; null uses the recorded rows as ticks."""
    vlm_reuse_count: int = Field(default=3, ge=1, le=1_000_000)
    """Ticks that share one pass of the model."""
    views: tuple[str, ...] | None = None
    """Cameras to keep; null keeps all."""
    action_rotation: Literal["auto", "rotvec", "euler_delta"] = "auto"
    """Rotation of actions derived from poses. rotvec: rotation vectors. euler_delta: wrapped
    differences of Euler angles, as in the old format. `auto` is rotvec if every recording has
    poses, else euler_delta."""
    on_bad_episode: Literal["stop", "skip"] = "stop"
    """stop: refuse to begin. skip: list bad episodes and leave them out."""

    @field_validator("sources", "views")
    @classmethod
    def _names_differ(
        cls, entries: tuple[Source | str, ...] | None
    ) -> tuple[Source | str, ...] | None:
        names = [entry if isinstance(entry, str) else entry.name for entry in entries or ()]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"names must differ; {', '.join(twice)} stands more than once")
        return entries


class AugmentationParams(Section):
    """Limits of the changes in augmented frames, drawn from the row's key and `seed`."""

    rotation_deg: float = Field(default=5.0, ge=0, le=45)
    """Largest rotation about the centre, in both directions."""
    crop: float = Field(default=0.9, gt=0, le=1)
    """Smallest side of the crop, as a share of the frame's side."""
    brightness: float = Field(default=0.2, ge=0, le=1)
    """Largest relative change, either way."""
    contrast: float = Field(default=0.2, ge=0, le=1)
    """Largest relative change, either way."""
    saturation: float = Field(default=0.2, ge=0, le=1)
    """Largest relative change, either way."""
    seed: Seed = 0
    """Seed of the draws for each row."""


class VLMParams(Section):
    """The frozen model and its features; all keys but `attention` are a feature's identity."""

    checkpoint: PathOrName = Field(min_length=1, max_length=3000)
    """A Qwen2.5-VL checkpoint folder or hub id."""
    revision: str | None = None
    """Revision of a hub id."""
    adapter: PathOrName | None = None
    """Folder of a peft adapter, merged into the weights."""
    dtype: Dtype = "bfloat16"
    """Precision in which the model computes."""
    attention: Literal["auto", "eager", "sdpa", "flash_attention_2"] = "auto"
    """Attention backend; recorded in the store, not part of a feature's identity."""
    image_resize_height: int = Field(default=360, ge=28, le=4096)
    """Pixels; rounded to a size that the processor accepts (360 -> 364)."""
    image_resize_width: int = Field(default=640, ge=28, le=4096)
    """Pixels; rounded to a size that the processor accepts (640 -> 644)."""
    prompt: str = "{instruction}\n{images}\n{instruction}"
    """Template of one user turn. Attention is causal: images see only the text before them."""
    layers: Layers = (-1,)
    """Decoder layers whose output is taken; 0 is the first, -1 the last; or all. vision: the output
    of the vision tower; alone, the language model does not run."""
    norms: tuple[bool, ...] = Field(default=(True,), min_length=1, max_length=2)
    """Whether the model's final norm is applied to a layer's output; [true, false] stores both."""
    pooling: tuple[Pooling, ...] = Field(default=("mean", "grid"), min_length=1, max_length=16)
    """Tokens that are averaged: mean: all. image_mean: of images. text_mean: of text. view_mean: of
    each view. grid: of each cell of a grid over each view; `{grid: [2, 2]}` has a size of its own.
    tokens: each image token alone. last: only the last token."""
    grid: tuple[GridSide, GridSide] = (4, 4)
    """Rows and columns of the `grid` pooling."""
    variants: int = Field(default=1, ge=1, le=1000)
    """Stored variants of each row: the plain frames, and variants - 1 augmented copies; training
    draws one of them per sample. Time and space grow by this factor."""
    augmentation: AugmentationParams = AugmentationParams()

    @field_validator("prompt")
    @classmethod
    def _known_placeholders(cls, prompt: str) -> str:
        if prompt.count("{images}") > 1:
            raise ValueError("{images} may stand once: each view is shown once")
        rest = prompt.replace("{instruction}", "").replace("{images}", "")
        if "{" in rest or "}" in rest:
            raise ValueError("only {instruction} and {images} may stand in braces")
        return prompt


class ExtractParams(Section):
    """Where the store is and how it is computed; only the dtypes affect its content."""

    store: Output = Path("cache_store/demo.zarr")
    """The store, whose name ends in .zarr; written once, then never modified."""
    dtype: FeatureDtype = "float32"
    """Type of the stored features. float8 and int8 take a quarter of float32, with scales of their
    own. `{pca: 128, then: int8}` keeps 128 numbers a slot, on the main directions of a sample of
    rows, in int8. stages.probe with `probe.codecs` says what each loses."""
    sensor_dtype: Literal["float32", "float16"] = "float32"
    """Type of the stored sensor stream."""
    batch_size: Literal["auto"] | Annotated[int, Field(ge=1, le=10_000)] = "auto"
    """Rows per forward pass, halved when memory runs out; auto finds the fastest size that fits."""
    workers: Workers = 0
    """0: this process; N: local dask processes; or the address of a dask scheduler."""
    retries: int = Field(default=2, ge=0, le=1000)
    """How often a worker's task is tried again before its recording is given up."""
    compile: bool = False
    """Compile the model with torch.compile (with CUDA graphs on a GPU): slow to start, then faster;
    the features are the same within the noise of vlm.dtype."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    decode_threads: int = Field(default=2, ge=1, le=256)
    """Threads that decode and resize while the model works."""
    plan: bool = False
    """Only print what would be done."""

    @field_validator("store")
    @classmethod
    def _named_zarr(cls, store: Path) -> Path:
        if store.suffix != ".zarr":
            raise ValueError("a store's name ends in .zarr")
        return store


class InspectParams(Section):
    """What is inspected, and how much of it is shown."""

    path: Globs | None = None
    """Recordings, folders or globs of recordings, or a store; null: the recordings of
    `data.sources`. Ticks, views and the feature spec follow the sections `data` and `vlm`."""
    format: RecordingFormat = "auto"
    """Format of the recordings at `path`."""
    episodes: int = Field(default=3, ge=1, le=10_000)
    """Episodes shown in detail: those with the worst findings first, then evenly spread ones. Every
    episode is checked."""
    ticks: int = Field(default=5, ge=1, le=1000)
    """Times in an episode at which its views are shown."""
    samples: int = Field(default=5, ge=1, le=1000)
    """Training samples shown side by side."""
    points: int = Field(default=4000, ge=100, le=1_000_000)
    """Most VL rows of a store in a picture, evenly spread."""
    seed: Seed = 0
    """Seed of the choice of samples."""
    rerun: bool = False
    """Write `episodes` episodes, evenly spread, as Rerun files (.rrd) in place of the page."""
    output: Output = Path("reports/inspect")
    """Folder of the page and its pictures. By default each `path` has its own folder in
    reports/inspect, so that one inspection does not replace the page of another."""


class VerifyParams(Section):
    """What is checked in a store."""

    store: Place | None = None
    """`extract.store` where null."""
    reextract: int = Field(default=0, ge=0, le=10**9)
    """Number of random rows to compute again with today's software and hardware."""
    tolerance: float | None = Field(default=None, gt=0, le=1e3)
    """Largest deviation of a recomputed number, relative to it or to its slot without the largest
    tenth; null: a value that fits the dtypes in which the row was computed and stored."""
    seed: Seed = 0
    """Seed of the choice of rows."""
    repair: bool = False
    """Make a damaged store again: keep its sound rows, compute the others."""
    checkpoint: Place | Literal[True] | None = None
    """Instead of a store, check that the model of `vlm` computes the features that this checkpoint
    was trained on; true: the checkpoint in `train_head.output`."""


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
    codecs: tuple[FeatureDtype, ...] = ()
    """Also say what these values of `extract.dtype` would lose: the error of the numbers, and the
    difference in R2. Run it on a store in float32."""
    time: bool = False
    """Also load the model of `vlm` and say how long a pass takes that stops after each layer."""
    threads: int = Field(default=2, ge=1, le=256)
    """Threads, each of which works on its own slot."""
    check_store: bool = True
    """First read the whole store, and refuse a chunk that does not give its checksum; false skips
    this, where it takes too long."""
    output: Output = Path("reports/probe")
    """Folder of the table and the picture."""


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
