"""Sections of the demo, the recordings, the frozen model, the extraction, and looking at them."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from pipeline.base.config.section import Globs, Output, PathOrName, Place, Section, Seed
from pipeline.base.config.stores import Workers

RecordingFormat = Literal["auto", "raw", "new", "old", "lerobot"]
Pooling = Literal["mean", "image_mean", "text_mean", "view_mean", "grid", "last"]
Dtype = Literal["float32", "float16", "bfloat16"]
GridSide = Annotated[int, Field(ge=1, le=64)]


class DemoParams(Section):
    """The simulated recordings and the small checkpoint that `stages.demo` writes."""

    recordings: Output = Path("data/demo")
    """Folder of the four sets of recordings."""
    checkpoint: Output = Path("models/demo_vlm")
    """Folder of a small Qwen2.5-VL with random weights."""
    episodes: int = Field(default=36, ge=2, le=10_000)
    """Episodes a format."""
    seed: Seed = 0
    """Of the simulation and of the checkpoint's weights."""


class MediaLimits(Section):
    """What a file of a recording may ask for; more is refused before memory is taken for it."""

    pixels: int = Field(default=7680 * 4320, ge=1, le=10**12)
    """Of one frame, its height times its width; by default that of 8K, which takes a second to
    decode."""
    array_bytes: int = Field(default=16 * 2**30, ge=1, le=2**50)
    """Of one array or table, unpacked."""
    ratio: float = Field(default=100.0, ge=1, le=1e6)
    """Unpacked bytes of a packed array or table by the bytes of its file; 256 MiB are always
    taken."""


class Source(Section):
    """One named set of recordings."""

    name: str = Field(min_length=1, max_length=200)
    """What `train_head.mixture` and reports call it."""
    path: Globs
    """Globs or paths: episode folders, folders of such, or LeRobot roots; relative to data.root."""
    format: RecordingFormat = "auto"
    """`auto` goes by the files that are there."""
    instruction: str | None = None
    """Replaces what the recording says."""
    action_kind: Literal["auto", "absolute", "velocity", "delta"] = "auto"
    """How a recorded action may be resampled; `auto` goes by format and channel names."""
    limits: MediaLimits = MediaLimits()

    @property
    def paths(self) -> tuple[str, ...]:
        """The globs as a tuple."""
        return (self.path,) if isinstance(self.path, str) else self.path


class DataParams(Section):
    """Which recordings, and how they become ticks."""

    root: Place = Path("data/demo")
    """What DVC watches; an absolute source path stands outside it."""
    sources: tuple[Source, ...] = Field(min_length=1)
    """Sets of recordings of one embodiment: the same action, state and sensor channels."""
    action_hz: float | None = Field(default=10.0, gt=0, le=1e4)
    """Ticks a second; null takes the recorded rows as they are."""
    vlm_reuse_count: int = Field(default=3, ge=1, le=1_000_000)
    """Ticks that share one answer of the model."""
    views: tuple[str, ...] | None = None
    """Cameras to keep; null keeps all."""
    action_rotation: Literal["auto", "rotvec", "euler_delta"] = "auto"
    """Of actions derived from poses: rotation vectors, or wrapped differences of Euler angles as
    the old format recorded them; `auto` is rotvec where every recording has poses."""
    on_bad_episode: Literal["stop", "skip"] = "stop"
    """Refuse to begin, or list bad episodes and leave them out."""

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
    """How far the augmented variants of a frame go; each is drawn from its row's key and `seed`."""

    rotation_deg: float = Field(default=5.0, ge=0, le=45)
    """Largest rotation about the centre, either way."""
    crop: float = Field(default=0.9, gt=0, le=1)
    """Smallest side of the crop, as a share of the frame's."""
    brightness: float = Field(default=0.2, ge=0, le=1)
    """Largest relative change, either way."""
    contrast: float = Field(default=0.2, ge=0, le=1)
    """Largest relative change, either way."""
    saturation: float = Field(default=0.2, ge=0, le=1)
    """Largest relative change, either way."""
    seed: Seed = 0
    """Of what is drawn for each row."""


class VLMParams(Section):
    """Which frozen model says what about an image; all but `attention` is a feature's identity."""

    checkpoint: PathOrName = Field(min_length=1, max_length=3000)
    """A Qwen2.5-VL checkpoint folder or hub id."""
    revision: str | None = None
    """Of a hub id."""
    adapter: PathOrName | None = None
    """Folder of a peft adapter, merged into the weights."""
    dtype: Dtype = "bfloat16"
    """What the model computes in."""
    attention: Literal["auto", "eager", "sdpa", "flash_attention_2"] = "auto"
    """Backend; recorded in the store, not part of a feature's identity."""
    image_resize_height: int = Field(default=360, ge=28, le=4096)
    """Pixels; rounded to what the processor takes (360 -> 364)."""
    image_resize_width: int = Field(default=640, ge=28, le=4096)
    """Pixels; rounded to what the processor takes (640 -> 644)."""
    prompt: str = "{instruction}\n{images}\n{instruction}"
    """One user turn. Attention is causal: images see only what stands before them."""
    layers: tuple[int, ...] = Field(default=(-1,), min_length=1, max_length=1000)
    """Decoder layers whose output is taken; 0 is the first, -1 the last."""
    norms: tuple[bool, ...] = Field(default=(True,), min_length=1, max_length=2)
    """Whether the model's final norm is applied to what a layer gives; both may be asked for."""
    pooling: tuple[Pooling, ...] = Field(default=("mean", "grid"), min_length=1, max_length=6)
    """Over which tokens: all, of images, of text, of each view, of the cells of a grid over each
    view, the last."""
    grid: tuple[GridSide, GridSide] = (4, 4)
    """Rows and columns of that grid."""
    variants: int = Field(default=1, ge=1, le=1000)
    """Views of each row that are encoded and stored: the frames as they are, and variants - 1
    augmented ones, among which training samples. Costs as many times the time and space."""
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
    """Where the store goes and how it is computed; only store and dtypes decide what it holds."""

    store: Output = Path("cache_store/demo.zarr")
    """Written once, then never modified."""
    dtype: Dtype = "float32"
    """Of stored features."""
    sensor_dtype: Literal["float32", "float16"] = "float32"
    """Of the stored sensor stream."""
    batch_size: Literal["auto"] | Annotated[int, Field(ge=1, le=10_000)] = "auto"
    """Rows a forward pass, halved when memory runs out; auto finds the fastest that fits."""
    workers: Workers = 0
    """0: this process; N: local dask processes; or the address of a dask scheduler."""
    retries: int = Field(default=2, ge=0, le=1000)
    """Times that a task of a worker is tried again before its recording is given up."""
    compile: bool = False
    """Compile the model with torch.compile (with CUDA graphs on a GPU): slow to begin, then faster;
    the same features within the noise of vlm.dtype."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    decode_threads: int = Field(default=2, ge=1, le=256)
    """Threads that decode and resize while the model works."""
    plan: bool = False
    """Only say what would be done."""

    @field_validator("store")
    @classmethod
    def _named_zarr(cls, store: Path) -> Path:
        if store.suffix != ".zarr":
            raise ValueError("a store's name ends in .zarr")
        return store


class InspectParams(Section):
    """What is looked at, and how much of it is shown."""

    path: Globs | None = None
    """Recordings, folders or globs of them, or a store; the recordings of `data.sources` where
    null or none. Ticks, views and the feature spec follow the sections `data` and `vlm`."""
    format: RecordingFormat = "auto"
    """Of the recordings at `path`."""
    episodes: int = Field(default=3, ge=1, le=10_000)
    """Episodes drawn in detail, evenly spread and those with the worst findings first; every one is
    checked."""
    ticks: int = Field(default=5, ge=1, le=1000)
    """Instants of an episode at which its views are shown."""
    samples: int = Field(default=5, ge=1, le=1000)
    """Training samples shown side by side."""
    points: int = Field(default=4000, ge=100, le=1_000_000)
    """VL rows of a store that pictures show at most, evenly spread."""
    seed: Seed = 0
    """Of the choice of samples."""
    output: Output = Path("reports/inspect")
    """Folder of the page and its pictures. Where it is not given, what `path` names has a folder of
    its own in reports/inspect, so that one inspection leaves another's page alone."""
