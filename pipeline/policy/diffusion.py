"""The action expert that removes noise step by step (Ho et al. 2020; Song et al. 2021)."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import torch
from torch import Generator

from pipeline.policy.attention import Projected
from pipeline.policy.denoiser import Denoiser
from pipeline.policy.expert import (
    Chunk,
    Context,
    DrawingExpert,
    Generators,
    Guide,
    Losses,
    StepMask,
    gain,
    pull,
    standard_normal,
    uniform,
)
from pipeline.policy.noise_schedule import NoiseSchedule, Prediction, ScheduleKind


class DiffusionActionExpert(DrawingExpert):
    """A denoising diffusion model of the chunk given the context.

    `sampler` ddpm visits every step of the schedule; ddim visits `sampling_steps` of them, with
    `eta` from 0 (nothing random but the first noise) to 1 (as random as ddpm). In each the
    predicted clean chunk is held within +-`clip`, and the step is taken from the chunk so held.
    """

    def __init__(
        self,
        *,
        horizon: int = 8,
        action_dim: int = 7,
        dim: int = 512,
        layers: int = 4,
        heads: int = 8,
        dropout: float = 0.1,
        draws: int = 1,
        timesteps: int = 100,
        schedule: ScheduleKind = "cosine",
        prediction: Prediction = "epsilon",
        sampler: Literal["ddpm", "ddim"] = "ddim",
        sampling_steps: int = 10,
        eta: float = 0.0,
        clip: float | None = 5.0,
        groups: Sequence[str] | None = None,
        group_weights: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(horizon, action_dim, dim, draws, groups, group_weights)
        self.prediction: Prediction = prediction
        self.sampler, self.eta, self.clip = sampler, eta, clip
        self.schedule = NoiseSchedule(timesteps, schedule)
        self.steps = self.schedule.steps(timesteps if sampler == "ddpm" else sampling_steps)
        self.denoiser = Denoiser(
            horizon=horizon, action_dim=action_dim, dim=dim, layers=layers, heads=heads,
            dropout=dropout,
        )  # fmt: skip

    def drawn_loss(
        self, context: Context, chunk: Chunk, valid: StepMask, generator: Generator | None
    ) -> Losses:
        """The grouped squared error of the prediction at drawn steps.

        A step of the schedule is drawn in proportion to its number: noisy ones, which tell the way
        from the context, more often than those that are nearly clean.
        """
        epsilon = standard_normal(chunk.shape, chunk.device, generator)
        drawn = uniform(len(chunk), chunk.device, generator).sqrt()
        step = 1 + (drawn * self.schedule.timesteps).long().clamp(max=self.schedule.timesteps - 1)
        noisy = self.schedule.add_noise(chunk, epsilon, step)
        predicted = self.denoiser(noisy, step / self.schedule.timesteps, context, valid)
        target = self.schedule.target(self.prediction, chunk, epsilon, step)
        return self.grouped(predicted, target, valid)

    @torch.no_grad()
    def act(
        self, context: Context, generator: Generators = None, guide: Guide | None = None
    ) -> Chunk:
        """A chunk drawn by the sampler, float32; from noise, the context and the generator.

        With a guide every step is taken from the clean chunk that it asks for.
        """
        shape = (context.shape[0], self.horizon, self.action_dim)
        chunk = standard_normal(shape, context.device, generator)
        prepared = self.denoiser.prepare(context)
        for step, to in pairwise(self.steps):
            if guide is None:
                sample = self.clean(chunk, step, prepared)
            else:
                sample = self.guided(chunk, step, prepared, guide)
            if self.sampler == "ddpm":
                chunk, variance = self.schedule.posterior(sample, chunk, step)
            else:
                chunk, variance = self.schedule.ddim(sample, chunk, step, to, self.eta)
            if self.sampler == "ddpm" or self.eta:
                noise = standard_normal(shape, context.device, generator)
                chunk = chunk + variance.sqrt() * noise
        return chunk

    def clean(self, noisy: Chunk, step: int, context: Context | Sequence[Projected]) -> Chunk:
        """The clean chunk that the network sees in a noisy one at this step, clipped."""
        return self._clipped(self._estimate(noisy, step, context))

    def guided(
        self, noisy: Chunk, step: int, context: Context | Sequence[Projected], guide: Guide
    ) -> Chunk:
        """The clean chunk at this step corrected by a guide, clipped.

        As flow matching would at the time where as much of the chunk is left: signal / noise. The
        clip has a slope of 1 here, so that what it holds can still be pulled.
        """
        with torch.enable_grad():
            noisy = noisy.detach().requires_grad_()
            estimate = self._estimate(noisy, step, context)
            sample = estimate + (self._clipped(estimate) - estimate).detach()
        signal, noise = (float(x[step]) for x in (self.schedule.signal, self.schedule.noise))
        change = noise * gain(signal, noise) * pull(sample, noisy, guide)
        return self._clipped(sample.detach() + change)

    def _estimate(self, noisy: Chunk, step: int, context: Context | Sequence[Projected]) -> Chunk:
        time = noisy.new_full(noisy.shape[:1], step / self.schedule.timesteps)
        predicted = self.denoiser(noisy, time, context)
        return self.schedule.sample_of(self.prediction, predicted, noisy, step)

    def _clipped(self, sample: Chunk) -> Chunk:
        return sample if self.clip is None else sample.clamp(-self.clip, self.clip)
