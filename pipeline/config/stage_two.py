"""Sections of training and evaluation."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from pipeline.config.section import Fraction, Section, Seed

Weight = Annotated[float, Field(ge=0)]


class SensorEncoderParams(Section):
    """Widths of the sensor encoder; the defaults, the seeds', cost 34 M parameters."""

    channels: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        default=(512, 1024, 1024, 1024), min_length=1
    )
    """Of each residual convolution block; every block halves the length."""
    layers: int = Field(default=2, ge=0)
    """Transformer layers after the convolutions."""
    heads: int = Field(default=8, ge=1)
    """Must divide the last of `channels`."""
    output_dim: int = Field(default=1024, ge=1)
    """Width of the encoded window."""


class StateEncoderParams(Section):
    """Widths of the robot-state encoder."""

    dim: int = Field(default=256, ge=1)
    """Width of its transformer."""
    layers: int = Field(default=2, ge=0)
    """Transformer layers."""
    heads: int = Field(default=8, ge=1)
    """Must divide `dim`."""
    output_dim: int = Field(default=512, ge=1)
    """Width of the encoded window."""
    patch: int = Field(default=10, ge=1)
    """Readings a token."""


class ExpertParams(Section):
    """Widths of the action expert."""

    dim: int = Field(default=512, ge=1)
    """Width of its transformer, and of the context it attends to."""
    layers: int = Field(default=4, ge=1)
    """Transformer layers."""
    heads: int = Field(default=8, ge=1)
    """Must divide `dim`."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """While training."""
    refinements: int = Field(default=1, ge=1)
    """Rounds of prediction; the first proposal is zeros, each later one the round before."""


class TrainHeadParams(Section):
    """What is trained from the store, and how."""

    model_type: Literal["regression"] = "regression"
    """The action expert."""
    fusion_strategy: Literal["concat"] = "concat"
    """How the encoded streams become the expert's context."""
    features_enabled: bool = True
    """Whether the policy sees the model's features."""
    sensor_enabled: bool = True
    """Whether the policy feels the sensor."""
    robot_state_enabled: bool = True
    """Whether the policy knows the robot's state."""
    sensor_encoder: SensorEncoderParams = SensorEncoderParams()
    state_encoder: StateEncoderParams = StateEncoderParams()
    expert: ExpertParams = ExpertParams()
    horizon: int = Field(default=8, ge=1)
    """Ticks an action chunk."""
    sensor_window: int = Field(default=65, ge=1)
    """Readings before the tick."""
    state_window: int = Field(default=100, ge=1)
    """Readings before the tick."""
    batch_size: int = Field(default=64, ge=1)
    """Ticks a step."""
    max_steps: int = Field(default=2000, ge=1)
    """Steps of the run; the learning rate's decay ends there."""
    warmup_steps: int = Field(default=100, ge=0)
    """Steps of linear warm-up."""
    lr: float = Field(default=3e-4, gt=0)
    """Peak learning rate of AdamW."""
    min_lr_fraction: Fraction = 0.05
    """Of the peak, at the end of the cosine decay."""
    weight_decay: float = Field(default=0.01, ge=0)
    """On matrices; norms, biases and embeddings are not decayed."""
    grad_clip: float = Field(default=1.0, gt=0)
    """Largest norm of the gradient."""
    ema_decay: float = Field(default=0.999, ge=0, lt=1)
    """Of the average of weights that is evaluated and kept."""
    amp: Literal["auto", "off", "bfloat16"] = "auto"
    """bfloat16 autocast; `auto` where a CUDA device has it."""
    group_weights: dict[Literal["translation", "rotation", "gripper", "other"], Weight] = Field(
        default_factory=dict
    )
    """Weight of each action group in the loss, 1 where not named."""
    val_fraction: Fraction = 0.1
    """Share of episodes held out."""
    mixture: dict[str, Weight] = Field(default_factory=dict)
    """Sampling weight of each source; 1 where not named."""
    eval_every: int = Field(default=200, ge=1)
    """Steps between evaluations on held-out ticks."""
    checkpoint_every: int = Field(default=200, ge=1)
    """Steps between checkpoints."""
    seed: Seed = 0
    """Of weights, order and dropout."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    store: Path | None = None
    """The store to train from; `extract.store` where null. Another one DVC does not watch."""
    output: Path = Path("models/head")
    """Folder of the best and the last checkpoint."""
    logs: Path = Path("reports/train_head")
    """Folder of the curves."""

    @field_validator("output", "logs")
    @classmethod
    def _has_a_name(cls, folder: Path) -> Path:
        if not folder.name:
            raise ValueError(f"must be a folder of its own, found {str(folder)!r}")
        return folder


class EvaluateParams(Section):
    """Which policy is judged, and where the report goes."""

    checkpoint: Path = Path("models/head")
    """A training run's folder, or one checkpoint in it."""
    output: Path = Path("reports/evaluate")
    """Folder of metrics, tables and pictures."""
    batch_size: int = Field(default=64, ge=1)
    """Ticks a forward pass."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    store: Path | None = None
    """The store to judge on; `train_head.store`, else `extract.store`, where null."""
