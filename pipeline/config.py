"""params.yaml -> Params: the only place that reads YAML.

Every section is a frozen model that forbids unknown keys, so that a misspelt key is an error and
not a default. All errors are reported at once.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from pipeline.errors import ConfigError

RecordingFormat = Literal["auto", "raw", "new", "old", "lerobot"]
Pooling = Literal["mean", "image_mean", "text_mean", "view_mean", "grid", "last"]
Dtype = Literal["float32", "float16", "bfloat16"]
Fraction = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """Base of every section: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Source(Section):
    """One named set of recordings."""

    name: str = Field(min_length=1)
    path: str | tuple[str, ...]
    """Globs or paths: episode folders, folders of such, or LeRobot roots."""
    format: RecordingFormat = "auto"
    instruction: str | None = None
    """Replaces what the recording says."""
    action_kind: Literal["auto", "absolute", "velocity", "delta"] = "auto"
    """How a recorded action may be resampled; `auto` goes by format and channel names."""

    @property
    def paths(self) -> tuple[str, ...]:
        """The globs as a tuple."""
        return (self.path,) if isinstance(self.path, str) else self.path


class DataParams(Section):
    """Which recordings, and how they become ticks."""

    root: Path = Path("data/demo")
    sources: tuple[Source, ...] = Field(min_length=1)
    action_hz: float | None = Field(default=10.0, gt=0)
    vlm_reuse_count: int = Field(default=3, ge=1)
    views: tuple[str, ...] | None = None
    action_rotation: Literal["auto", "rotvec", "euler_delta"] = "auto"
    on_bad_episode: Literal["stop", "skip"] = "stop"

    @field_validator("sources")
    @classmethod
    def _names_differ(cls, sources: tuple[Source, ...]) -> tuple[Source, ...]:
        names = [source.name for source in sources]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"source names must differ; {', '.join(twice)} stands more than once")
        return sources


class VLMParams(Section):
    """Which frozen model says what about an image; all of it is part of a feature's identity."""

    checkpoint: str
    revision: str | None = None
    adapter: str | None = None
    dtype: Dtype = "bfloat16"
    attention: Literal["auto", "eager", "sdpa", "flash_attention_2"] = "auto"
    image_resize_height: int = Field(default=360, ge=28)
    image_resize_width: int = Field(default=640, ge=28)
    prompt: str = "{instruction}\n{images}\n{instruction}"
    layers: tuple[int, ...] = Field(default=(-1,), min_length=1)
    """Decoder layers whose output is taken; 0 is the first, -1 the last."""
    norms: tuple[bool, ...] = Field(default=(True,), min_length=1)
    """Whether the model's final norm is applied to what a layer gives; both may be asked for."""
    pooling: tuple[Pooling, ...] = Field(default=("mean",), min_length=1)

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

    store: Path = Path("cache_store/demo.zarr")
    dtype: Dtype = "float32"
    sensor_dtype: Literal["float32", "float16"] = "float32"
    batch_size: Literal["auto"] | Annotated[int, Field(ge=1)] = "auto"
    workers: Literal[0] = 0
    """Local processes or a scheduler address; so far only 0, this process."""
    device: str = "auto"
    decode_threads: int = Field(default=2, ge=1)
    plan: bool = False

    @field_validator("store")
    @classmethod
    def _named_zarr(cls, store: Path) -> Path:
        if store.suffix != ".zarr":
            raise ValueError(f"a store's name ends in .zarr, found {store}")
        return store


class SensorEncoderParams(Section):
    """Widths of the sensor encoder; the seeds' 512, 1024, 1024, 1024 cost about 20 M parameters."""

    channels: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        default=(512, 1024, 1024, 1024), min_length=1
    )
    layers: int = Field(default=2, ge=0)
    heads: int = Field(default=8, ge=1)
    output_dim: int = Field(default=1024, ge=1)


class StateEncoderParams(Section):
    """Widths of the robot-state encoder."""

    dim: int = Field(default=256, ge=1)
    layers: int = Field(default=2, ge=0)
    heads: int = Field(default=8, ge=1)
    output_dim: int = Field(default=512, ge=1)
    patch: int = Field(default=10, ge=1)
    """Readings a token."""


class ExpertParams(Section):
    """Widths of the action expert."""

    dim: int = Field(default=512, ge=1)
    layers: int = Field(default=4, ge=1)
    heads: int = Field(default=8, ge=1)
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    refinements: int = Field(default=1, ge=1)
    """Rounds of prediction; the first proposal is zeros, each later one the round before."""


class TrainHeadParams(Section):
    """What is trained from the store, and how."""

    model_type: Literal["regression"] = "regression"
    fusion_strategy: Literal["concat"] = "concat"
    features_enabled: bool = True
    sensor_enabled: bool = True
    robot_state_enabled: bool = True
    sensor_encoder: SensorEncoderParams = SensorEncoderParams()
    state_encoder: StateEncoderParams = StateEncoderParams()
    expert: ExpertParams = ExpertParams()
    horizon: int = Field(default=8, ge=1)
    sensor_window: int = Field(default=65, ge=1)
    state_window: int = Field(default=100, ge=1)
    batch_size: int = Field(default=64, ge=1)
    max_steps: int = Field(default=2000, ge=1)
    warmup_steps: int = Field(default=100, ge=0)
    lr: float = Field(default=3e-4, gt=0)
    min_lr_fraction: Fraction = 0.05
    weight_decay: float = Field(default=0.01, ge=0)
    grad_clip: float = Field(default=1.0, gt=0)
    ema_decay: float = Field(default=0.999, ge=0, lt=1)
    amp: Literal["auto", "off", "bfloat16"] = "auto"
    group_weights: dict[Literal["translation", "rotation", "gripper", "other"], float] = {}
    """Weight of each action group in the loss, 1 where not named."""
    val_fraction: Fraction = 0.1
    mixture: dict[str, Annotated[float, Field(ge=0)]] = {}
    """Sampling weight of each source; 1 where not named."""
    eval_every: int = Field(default=200, ge=1)
    checkpoint_every: int = Field(default=200, ge=1)
    seed: int = 0
    device: str = "auto"
    store: Path | None = None
    """The store to train from; `extract.store` where null."""
    output: Path = Path("models/head")
    logs: Path = Path("reports/train_head")


class EvaluateParams(Section):
    """Which policy is judged, and where the report goes."""

    checkpoint: Path = Path("models/head")
    output: Path = Path("reports/evaluate")
    batch_size: int = Field(default=64, ge=1)
    device: str = "auto"
    store: Path | None = None


class DemoParams(Section):
    """The simulated recordings and the small checkpoint that `stages.demo` writes."""

    recordings: Path = Path("data/demo")
    checkpoint: Path = Path("models/demo_vlm")
    episodes: int = Field(default=12, ge=2)
    """Episodes a format."""
    seed: int = 0


class Params(Section):
    """All of params.yaml."""

    demo: DemoParams = DemoParams()
    data: DataParams
    vlm: VLMParams
    extract: ExtractParams = ExtractParams()
    train_head: TrainHeadParams = TrainHeadParams()
    evaluate: EvaluateParams = EvaluateParams()

    @model_validator(mode="after")
    def _mixture_names_sources(self) -> "Params":
        unknown = set(self.train_head.mixture) - {source.name for source in self.data.sources}
        if unknown:
            raise ValueError(
                f"train_head.mixture names {', '.join(sorted(unknown))}, "
                f"but data.sources has {', '.join(s.name for s in self.data.sources)}"
            )
        return self


def load_params(path: Path, overrides: Sequence[str] = ()) -> Params:
    """The params of a YAML file with `section.key=value` overrides laid over it.

    A value is YAML, so `[1, 2]`, `null` and JSON work. Raises `ConfigError` with every problem.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file. Run from the project's root or pass --params FILE."
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise ConfigError(f"{path}: cannot be read as YAML: {error}") from None
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: expected sections such as `data:`, found {document!r}")
    for override in overrides:
        _lay_over(document, override)
    try:
        return Params.model_validate(document)
    except ValidationError as error:
        raise ConfigError(_all_problems(error, path)) from None


def _lay_over(document: dict[str, Any], override: str) -> None:
    dotted, equals, text = override.partition("=")
    keys = dotted.split(".")
    if not equals or len(keys) < 2 or not all(keys):
        raise ConfigError(f"--set {override}: expected section.key=value")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"--set {override}: the value is not YAML (put a text that begins with a brace or a "
            f"bracket in quotes of its own): {error}"
        ) from None
    node = document
    for depth, key in enumerate(keys[:-1], start=1):
        child = node.get(key)
        if child is None:
            child = node[key] = {}
        if not isinstance(child, dict):
            raise ConfigError(
                f"--set {override}: {'.'.join(keys[:depth])} is a {type(child).__name__}, "
                "not a section; set it whole"
            )
        node = child
    node[keys[-1]] = value


def _all_problems(error: ValidationError, path: Path) -> str:
    lines = [f"{path}: {error.error_count()} problem(s)"]
    for problem in error.errors():
        place = ".".join(str(part) for part in problem["loc"]) or "params"
        found = (
            ""
            if problem["type"] in ("missing", "extra_forbidden")
            else (f" (found {problem['input']!r:.200})")
        )
        lines.append(f"  {place}: {problem['msg']}{found}")
    return "\n".join(lines)
