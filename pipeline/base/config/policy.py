"""Sections of the policy's parts: encoders and action experts."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.base.config.section import Section


class SensorEncoderParams(Section):
    """Widths of the sensor encoder; its size and cost are printed when a training begins."""

    kind: Literal["joint", "force_aware"] = "joint"
    """One branch for all channels, or one of its own for force, so that it is not drowned."""
    channels: tuple[Annotated[int, Field(ge=1, le=8192)], ...] = Field(
        default=(64, 128, 128, 128), min_length=1, max_length=16
    )
    """Of each residual convolution block; every block halves the length."""
    layers: int = Field(default=1, ge=0, le=128)
    """Transformer layers after the convolutions."""
    heads: int = Field(default=4, ge=1, le=256)
    """Must divide the last of `channels`."""
    output_dim: int = Field(default=128, ge=1, le=8192)
    """Width of the encoded window."""


class StateEncoderParams(Section):
    """Widths of the robot-state encoder."""

    dim: int = Field(default=64, ge=1, le=8192)
    """Width of its transformer."""
    layers: int = Field(default=1, ge=0, le=128)
    """Transformer layers."""
    heads: int = Field(default=4, ge=1, le=256)
    """Must divide `dim`."""
    output_dim: int = Field(default=64, ge=1, le=8192)
    """Width of the encoded window."""
    patch: int = Field(default=10, ge=1, le=10_000)
    """Readings a token."""


class ExpertParams(Section):
    """Widths of the action expert, whichever it is."""

    dim: int = Field(default=128, ge=1, le=8192)
    """Width of its transformer, and of the context it attends to."""
    layers: int = Field(default=2, ge=1, le=128)
    """Transformer layers."""
    heads: int = Field(default=4, ge=1, le=256)
    """Must divide `dim`."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """While training."""


class RegressionParams(Section):
    """What only the regression expert has."""

    refinements: int = Field(default=1, ge=1, le=100)
    """Rounds of prediction; the first proposal is zeros, each later one the round before."""


class DiffusionParams(Section):
    """What only the diffusion expert has."""

    draws: int = Field(default=3, ge=1, le=1000)
    """Noises and steps of the schedule that each chunk is trained on at once: the context, which
    costs most, is computed once for all of them."""
    timesteps: int = Field(default=100, ge=2, le=10_000)
    """Steps of the noise schedule."""
    schedule: Literal["cosine", "linear"] = "cosine"
    """How the noise grows over them."""
    prediction: Literal["epsilon", "sample", "v"] = "sample"
    """What the network predicts: the noise, the clean chunk, or the velocity between them."""
    sampler: Literal["ddpm", "ddim"] = "ddim"
    """`ddpm` takes every step of the schedule, `ddim` as many as `sampling_steps`."""
    sampling_steps: int = Field(default=4, ge=1, le=10_000)
    """Of `ddim`; at most `timesteps`."""
    eta: float = Field(default=0.0, ge=0, le=1)
    """Of `ddim`: 0 is deterministic after the first noise, 1 as random as `ddpm`."""
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
    """What only the flow-matching expert has."""

    draws: int = Field(default=3, ge=1, le=1000)
    """As `diffusion.draws`: noises and times at once."""
    sampling_steps: int = Field(default=4, ge=1, le=10_000)
    """Of the ODE solver."""
    solver: Literal["euler", "midpoint", "rk4"] = "euler"
    """One, two or four evaluations of the network a step."""
    time: Literal["uniform", "beta"] = "beta"
    """How times are drawn in training."""
    alpha: float = Field(default=1.5, gt=0, le=1e3)
    """Of the beta distribution of the noise's share 1 - t: above `beta`, noisy times are drawn
    more often (Black et al. 2024)."""
    beta: float = Field(default=1.0, gt=0, le=1e3)
    """Of the beta distribution."""
