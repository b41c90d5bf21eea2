"""The action expert that removes noise step by step (Ho et al. 2020; Song et al. 2021).

Steps count as in the papers: 0 is clean and `timesteps` is almost pure noise. At step t a sample
x0 and a standard normal epsilon make `x_t = signal[t] x0 + noise[t] epsilon`.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn

from pipeline.policy.denoiser import DrawingExpert, Source, gain, pull
from pipeline.policy.expert import (
    Chunk,
    Context,
    Generators,
    Guide,
    Losses,
    StepMask,
    standard_normal,
    uniform,
)

Prediction = Literal["epsilon", "sample", "v"]


class DiffusionActionExpert(DrawingExpert):
    """A denoising diffusion model of the chunk given the context.

    `sampler` ddpm visits every step of the schedule; ddim visits `sampling_steps` of them, with
    `eta` from 0 (random is only the first noise) to 1 (as random as ddpm). Each step clips the
    predicted clean chunk to +-`clip` and continues from the clipped chunk.
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
        prediction: Prediction = "epsilon",
        sampler: Literal["ddpm", "ddim"] = "ddim",
        sampling_steps: int = 10,
        eta: float = 0.0,
        clip: float | None = 5.0,
        groups: Sequence[str] | None = None,
        group_weights: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(
            horizon, action_dim, dim, layers, heads, dropout, draws, groups, group_weights
        )
        self.prediction: Prediction = prediction
        self.sampler, self.eta, self.clip = sampler, eta, clip
        self.schedule = NoiseSchedule(timesteps)
        self.steps = self.schedule.steps(timesteps if sampler == "ddpm" else sampling_steps)

    def drawn_loss(
        self, context: Context, chunk: Chunk, valid: StepMask, generator: Generator | None
    ) -> Losses:
        """The grouped squared error of the prediction at drawn steps.

        A step of the schedule is drawn in proportion to its number: noisy steps, where the network
        learns from the context, more often than nearly clean ones.
        """
        epsilon = standard_normal(chunk.shape, chunk.device, generator)
        drawn = uniform(len(chunk), chunk.device, generator).sqrt()
        step = 1 + (drawn * self.schedule.timesteps).long().clamp(max=self.schedule.timesteps - 1)
        noisy = self.schedule.add_noise(chunk, epsilon, step)
        predicted = self.denoiser(noisy, step / self.schedule.timesteps, context, valid)
        target = self.schedule.target(self.prediction, chunk, epsilon, step)
        return self.grouped(predicted, target, valid)

    def denoise(
        self, noise: Chunk, context: Source, generator: Generators, guide: Guide | None
    ) -> Chunk:
        """The sampler's chunk; a guide corrects the clean chunk that each step is taken from."""
        chunk = noise
        for step, to in pairwise(self.steps):
            if guide is None:
                sample = self.clean(chunk, step, context)
            else:
                sample = self.guided(chunk, step, context, guide)
            if self.sampler == "ddpm":
                chunk, variance = self.schedule.posterior(sample, chunk, step)
            else:
                chunk, variance = self.schedule.ddim(sample, chunk, step, to, self.eta)
            if self.sampler == "ddpm" or self.eta:
                drawn = standard_normal(chunk.shape, chunk.device, generator)
                chunk = chunk + variance.sqrt() * drawn
        return chunk

    def clean(self, noisy: Chunk, step: int, context: Source) -> Chunk:
        """The clean chunk that the network predicts from a noisy one at this step, clipped."""
        return self._clipped(self._estimate(noisy, step, context))

    def guided(self, noisy: Chunk, step: int, context: Source, guide: Guide) -> Chunk:
        """The clean chunk at this step corrected by a guide, clipped.

        The correction is that of flow matching at the time with the same ratio signal / noise. The
        clip has a slope of 1 here, so that the guide also pulls what the clip holds.
        """
        with torch.enable_grad():
            noisy = noisy.detach().requires_grad_()
            estimate = self._estimate(noisy, step, context)
            sample = estimate + (self._clipped(estimate) - estimate).detach()
        signal, noise = (float(x[step]) for x in (self.schedule.signal, self.schedule.noise))
        change = noise * gain(signal, noise) * pull(sample, noisy, guide)
        return self._clipped(sample.detach() + change)

    def _estimate(self, noisy: Chunk, step: int, context: Source) -> Chunk:
        time = noisy.new_full(noisy.shape[:1], step / self.schedule.timesteps)
        predicted = self.denoiser(noisy, time, context)
        return self.schedule.sample_of(self.prediction, predicted, noisy, step)

    def _clipped(self, sample: Chunk) -> Chunk:
        return sample if self.clip is None else sample.clamp(-self.clip, self.clip)


class NoiseSchedule(nn.Module):
    """The noise schedule: how much of a sample and how much noise is left at every step.

    `alpha_bar`, its roots `signal` = sqrt(alpha_bar) and `noise` = sqrt(1 - alpha_bar), each
    (timesteps + 1,), are buffers: they move with the module, and weights come back with the
    schedule that they were trained on.
    """

    alpha_bar: Tensor
    signal: Tensor
    noise: Tensor

    def __init__(self, timesteps: int = 100) -> None:
        super().__init__()
        self.timesteps = timesteps
        betas = _cosine_betas(timesteps)
        clean = torch.ones(1, dtype=torch.float64, device="cpu")
        alpha_bar = torch.cat([clean, (1 - betas).cumprod(0)])
        # Rounded at the end: of 1 - alpha_bar, float32 has few digits left at small steps.
        self.register_buffer("alpha_bar", alpha_bar.float())
        self.register_buffer("signal", alpha_bar.sqrt().float())
        self.register_buffer("noise", (1 - alpha_bar).sqrt().float())

    def steps(self, count: int) -> list[int]:
        """`count` falling steps and then 0, evenly spaced: what a sampler visits.

        A sampler begins with pure noise, so it must begin near the top, or its mean is pulled
        towards the noise's; but at the very top nothing is left of the sample, so a predicted
        epsilon says nothing about it: where there is a choice, the first step is at 98 %. The last
        is at half an interval of the schedule, so that the final jump keeps the spread.
        """
        first = max(count, round(0.98 * self.timesteps))
        last = max(1, round(self.timesteps / count / 2)) if count > 1 else first
        shares = [index / max(1, count - 1) for index in range(count)]
        return [round(first + (last - first) * share) for share in shares] + [0]

    def add_noise(self, sample: Chunk, epsilon: Chunk, step: Int[Tensor, " batch"]) -> Chunk:
        """The noisy chunk at each row's step (Ho et al. 2020, eq. 4)."""
        return self._at(self.signal, step) * sample + self._at(self.noise, step) * epsilon

    def target(
        self, kind: Prediction, sample: Chunk, epsilon: Chunk, step: Int[Tensor, " batch"]
    ) -> Chunk:
        """What a network of this kind learns to predict (v: Salimans & Ho 2022, section 4)."""
        if kind == "epsilon":
            return epsilon
        if kind == "sample":
            return sample
        return self._at(self.signal, step) * epsilon - self._at(self.noise, step) * sample

    def sample_of(
        self, kind: Prediction, predicted: Chunk, noisy: Chunk, step: Int[Tensor, " batch"] | int
    ) -> Chunk:
        """The clean chunk that a prediction stands for; steps are above 0."""
        signal, noise = self._at(self.signal, step), self._at(self.noise, step)
        if kind == "epsilon":
            return (noisy - noise * predicted) / signal
        if kind == "sample":
            return predicted
        return signal * noisy - noise * predicted

    def epsilon_of(self, sample: Chunk, noisy: Chunk, step: Int[Tensor, " batch"] | int) -> Chunk:
        """The noise between a clean chunk and a noisy one; steps are above 0."""
        return (noisy - self._at(self.signal, step) * sample) / self._at(self.noise, step)

    def posterior(self, sample: Chunk, noisy: Chunk, step: int) -> tuple[Chunk, Float[Tensor, ""]]:
        """Mean and variance of step - 1 given this step and the clean chunk (Ho 2020, eq. 7).

        The caller clips `sample`; the mean depends on the arguments alone.
        """
        before, now = self.alpha_bar[step - 1], self.alpha_bar[step]
        beta = 1 - now / before
        cleaned = self.noise[step - 1] ** 2 / self.noise[step] ** 2
        mean = before.sqrt() * beta / self.noise[step] ** 2 * sample
        return mean + (1 - beta).sqrt() * cleaned * noisy, cleaned * beta

    def ddim(
        self, sample: Chunk, noisy: Chunk, step: int, to: int, eta: float
    ) -> tuple[Chunk, Float[Tensor, ""]]:
        """Mean and variance of step `to` < `step` (Song et al. 2021, eq. 12 and 16).

        The noise of eq. 12 is that between `sample` and `noisy`, also where the caller clipped
        `sample`, so that `eta` = 1 from each step to the next equals `posterior`.
        """
        ratio = self.alpha_bar[step] / self.alpha_bar[to]
        cleaned = self.noise[to] ** 2 / self.noise[step] ** 2
        variance = eta**2 * cleaned * (1 - ratio)
        epsilon = self.epsilon_of(sample, noisy, step)
        left = (self.noise[to] ** 2 - variance).clamp(min=0).sqrt()
        return self.signal[to] * sample + left * epsilon, variance

    def _at(self, values: Tensor, step: Tensor | int) -> Tensor:
        return values[step].view(-1, 1, 1)


def _cosine_betas(timesteps: int) -> Tensor:
    """Nichol & Dhariwal 2021, eq. 17, betas held at 0.999 as there."""
    share = torch.linspace(0, 1, timesteps + 1, dtype=torch.float64, device="cpu")
    alpha_bar = torch.cos((share + 0.008) / 1.008 * math.pi / 2) ** 2
    return (1 - alpha_bar[1:] / alpha_bar[:-1]).clamp(max=0.999)
