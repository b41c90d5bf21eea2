"""Sections of the policy's parts: encoders and action experts."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.base.config.section import Section


class SensorEncoderParams(Section):
    """Sizes of the sensor encoder; its parameters and cost are printed when training begins."""

    kind: Literal["joint", "force_aware"] = "joint"
    """joint: one branch for all channels. force_aware: force has its own and is not lost."""
    channels: tuple[Annotated[int, Field(ge=1, le=8192)], ...] = Field(
        default=(64, 128, 128, 128), min_length=1, max_length=16
    )
    """Width of each residual convolution block; every block halves the length."""
    layers: int = Field(default=1, ge=0, le=128)
    """Transformer layers after the convolutions."""
    heads: int = Field(default=4, ge=1, le=256)
    """Attention heads; must divide the last of `channels`."""
    output_dim: int = Field(default=128, ge=1, le=8192)
    """Width of the encoded window."""


class StateEncoderParams(Section):
    """Sizes of the robot-state encoder."""

    dim: int = Field(default=64, ge=1, le=8192)
    """Width of its transformer."""
    layers: int = Field(default=1, ge=0, le=128)
    """Transformer layers."""
    heads: int = Field(default=4, ge=1, le=256)
    """Must divide `dim`."""
    output_dim: int = Field(default=64, ge=1, le=8192)
    """Width of the encoded window."""
    patch: int = Field(default=10, ge=1, le=10_000)
    """Readings per token."""


class ExpertParams(Section):
    """Sizes of the action expert, of any kind."""

    dim: int = Field(default=128, ge=1, le=8192)
    """Width of its transformer and of its context."""
    layers: int = Field(default=2, ge=1, le=128)
    """Transformer layers."""
    heads: int = Field(default=4, ge=1, le=256)
    """Must divide `dim`."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """Dropout during training."""


class RegressionParams(Section):
    """Params of the regression expert only."""

    refinements: int = Field(default=1, ge=1, le=100)
    """Rounds of prediction; the first starts from zeros, each later one from the round before."""


class DiffusionParams(Section):
    """Params of the diffusion expert only."""

    draws: int = Field(default=3, ge=1, le=1000)
    """Draws of noise and schedule step per chunk in a training step. The context, which costs most,
    is computed once for all of them."""
    timesteps: int = Field(default=100, ge=2, le=10_000)
    """Steps of the noise schedule."""
    schedule: Literal["cosine", "linear"] = "cosine"
    """How the noise grows over the steps."""
    prediction: Literal["epsilon", "sample", "v"] = "sample"
    """What the network predicts: the noise, the clean chunk, or the velocity between them."""
    sampler: Literal["ddpm", "ddim"] = "ddim"
    """`ddpm` takes every step of the schedule, `ddim` takes `sampling_steps`."""
    sampling_steps: int = Field(default=4, ge=1, le=10_000)
    """Steps of `ddim`; at most `timesteps`."""
    eta: float = Field(default=0.0, ge=0, le=1)
    """Randomness of `ddim`: 0 is deterministic after the first noise, 1 is as random as `ddpm`."""
    clip: float | None = Field(default=5.0, gt=0, le=1e6)
    """The clean chunk is clipped to this many standard deviations in every sampling step."""

    @model_validator(mode="after")
    def _steps_are_of_the_schedule(self) -> "DiffusionParams":
        if self.sampler == "ddim" and self.sampling_steps > self.timesteps:
            raise ValueError(
                f"sampling_steps {self.sampling_steps} is above timesteps {self.timesteps}"
            )
        return self


class FlowMatchingParams(Section):
    """Params of the flow-matching expert only."""

    draws: int = Field(default=3, ge=1, le=1000)
    """Draws of noise and time per chunk in a training step, as in `diffusion.draws`."""
    sampling_steps: int = Field(default=4, ge=1, le=10_000)
    """Steps of the ODE solver."""
    solver: Literal["euler", "midpoint", "rk4"] = "euler"
    """ODE solver: one, two or four evaluations of the network per step."""
    time: Literal["uniform", "beta"] = "beta"
    """Distribution of the times in training."""
    alpha: float = Field(default=1.5, gt=0, le=1e3)
    """First parameter of the beta distribution of the noise's share 1 - t: larger than `beta` draws
    noisy times more often (Black et al. 2024)."""
    beta: float = Field(default=1.0, gt=0, le=1e3)
    """Second parameter of that beta distribution."""
