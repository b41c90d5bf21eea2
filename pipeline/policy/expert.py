"""The contract of an action expert: its tensors, the guide of its samples, its grouped loss.

A guide makes a sampled chunk continue another one (real-time chunking: Black, Galliker and Levine
2025, "Real-Time Execution of Action Chunking Flow Policies", eq. 2 to 4): in every step the expert
is pulled to where the clean chunk that it sees would agree with the guide's.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from pipeline.base.errors import ConfigError

Context = Float[Tensor, "batch token dim"]
"""What an action expert attends to."""
Chunk = Float[Tensor, "batch horizon action"]
"""Action chunks: the steps of a horizon, one value a channel."""
StepMask = Bool[Tensor, "batch horizon"]
"""Which steps of a chunk are real."""
Losses = tuple[Float[Tensor, ""], dict[str, Tensor]]
"""The scalar to minimise, and its detached parts by name."""
Generators = Generator | Sequence[Generator] | Iterator[Tensor] | None
"""What draws a batch: one generator for all of it, one a sample, or the device's own; or the noise
itself, in the order in which a sampler asks for it."""
ErrorKind = Literal["smooth_l1", "mse"]
MOST_GAIN = 5.0
"""beta of the paper: a few sampling steps do not bear the gains that theory gives near both ends
(appendix A.2 there)."""


@dataclass(frozen=True)
class Guide:
    """The chunk to continue, and how strongly each of its steps counts, from 0 to 1.

    A step of weight 0 changes nothing, whatever finite values stand in it.
    """

    chunk: Chunk
    weight: Float[Tensor, "batch horizon"]

    def repeat(self, times: int) -> "Guide":
        """The guide of a batch repeated as a whole."""
        return Guide(self.chunk.repeat(times, 1, 1), self.weight.repeat(times, 1))


def pull(clean: Chunk, noisy: Chunk, guide: Guide) -> Chunk:
    """How to change the noisy chunk so that the clean one, computed from it, nears the guide.

    The vector-Jacobian product (Y - clean)^T diag(W) d clean / d noisy of eq. 2.
    """
    error = guide.weight.unsqueeze(-1) * (guide.chunk - clean.detach())
    return torch.autograd.grad(clean, noisy, error)[0]


def gain(signal: float, noise: float) -> float:
    """The factor of `pull` in dx/dt where x = signal * clean + noise * epsilon.

    (signal^2 + noise^2) / (signal * noise), at most `MOST_GAIN`: the factor of eq. 2, with
    signal = tau and noise = 1 - tau there. A clean chunk is changed by `noise` times as much.
    """
    product = signal * noise
    return min(MOST_GAIN, (signal**2 + noise**2) / product) if product else MOST_GAIN


class ActionExpert(nn.Module, ABC):
    """Context in, action chunk out; all actions are normalised units.

    `loss` sees the recorded chunk, `act` never does: an expert that predicts directly must form
    its prediction in a function that takes the context alone, and use it in both. A `stochastic`
    expert draws its chunks, and everything random in its loss but dropout, from the generator it
    is given, on whichever device that is, or else from the global one of the context's device.
    """

    stochastic: ClassVar[bool]

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        groups: Sequence[str] | None,
        group_weights: Mapping[str, float] | None,
        error: ErrorKind,
    ) -> None:
        """`groups` names the loss group of each action channel, all `other` where None."""
        super().__init__()
        self.horizon, self.action_dim = horizon, action_dim
        named = groups or ("other",) * action_dim
        self.grouped = GroupedLoss(named, group_weights or {}, error)

    @abstractmethod
    def loss(
        self, context: Context, actions: Chunk, valid: StepMask, generator: Generator | None = None
    ) -> Losses:
        """The scalar to minimise and its detached parts by name; masked steps count nothing."""

    @abstractmethod
    def act(
        self, context: Context, generator: Generators = None, guide: Guide | None = None
    ) -> Chunk:
        """A chunk; the same for the same context, generator state and guide.

        Only a `stochastic` expert is given a guide: a chunk to continue, in normalised units.
        """


class GroupedLoss(nn.Module):
    """An error averaged over the valid entries of each action group.

    The error of an entry is smooth-L1 (Girshick 2015, eq. 3) or its square (`mse`).

    The total is the mean of the groups under `weights` (1 where not named): three rotation
    channels count as much as three hundred, and the total does not grow with the groups. Raises
    `ConfigError` where no group has weight.
    """

    membership: Tensor
    weights: Tensor

    def __init__(
        self, groups: Sequence[str], weights: Mapping[str, float], kind: ErrorKind = "smooth_l1"
    ) -> None:
        super().__init__()
        self.error = F.smooth_l1_loss if kind == "smooth_l1" else F.mse_loss
        self.names = tuple(sorted(set(groups)))
        chosen = [float(weights.get(name, 1.0)) for name in self.names]
        if min(chosen) < 0 or sum(chosen) <= 0:
            raise ConfigError(
                "train_head.group_weights: expected weights >= 0 and one above 0 among "
                f"{', '.join(self.names)}, found {dict(zip(self.names, chosen, strict=True))}"
            )
        membership = torch.tensor([[group == name for group in groups] for name in self.names])
        self.register_buffer("membership", membership.float(), persistent=False)
        normalised = torch.tensor(chosen) / sum(chosen)
        self.register_buffer("weights", normalised, persistent=False)

    def forward(self, prediction: Chunk, target: Chunk, valid: StepMask) -> Losses:
        """The weighted mean over the groups, and each group's own mean, detached."""
        mask = valid.unsqueeze(-1)
        target = target.masked_fill(~mask, 0.0)
        error = self.error(prediction.float(), target.float(), reduction="none")
        per_channel = error.masked_fill(~mask, 0.0).sum(dim=(0, 1))
        entries = valid.sum() * self.membership.sum(dim=1)
        means = (self.membership * per_channel).sum(dim=1) / entries.clamp(min=1)
        parts = dict(zip(self.names, means.detach().unbind(), strict=True))
        return (means * self.weights).sum(), parts


class DrawingExpert(ActionExpert):
    """An expert that draws its chunks, and learns from `draws` noises a chunk at once.

    In training alone a linear layer, `direct`, also predicts the chunk from the context's mean: so
    the context soon tells what the chunk depends on, which noise hides at first. The loss has half
    of its squared error besides.
    """

    stochastic = True

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        dim: int,
        draws: int,
        groups: Sequence[str] | None,
        group_weights: Mapping[str, float] | None,
    ) -> None:
        super().__init__(horizon, action_dim, groups, group_weights, "mse")
        self.draws = draws
        self.direct = nn.Linear(dim, horizon * action_dim)

    def loss(
        self, context: Context, actions: Chunk, valid: StepMask, generator: Generator | None = None
    ) -> Losses:
        """The loss of `draws` noises a chunk and that of `direct`; the parts are of the noises."""
        chunk = actions.float().masked_fill(~valid.unsqueeze(-1), 0.0)
        direct = self.direct(context.mean(dim=1)).unflatten(-1, chunk.shape[1:])
        guessed = self.grouped(direct, chunk, valid)[0]
        context, chunk = (x.repeat(self.draws, 1, 1) for x in (context, chunk))
        drawn, parts = self.drawn_loss(context, chunk, valid.repeat(self.draws, 1), generator)
        return drawn + guessed / 2, parts

    @abstractmethod
    def drawn_loss(
        self, context: Context, chunk: Chunk, valid: StepMask, generator: Generator | None
    ) -> Losses:
        """The loss of one noise a chunk; steps that are not valid are 0."""


def standard_normal(
    shape: Sequence[int], device: torch.device, generator: Generators
) -> Float[Tensor, "..."]:
    """Float32 noise on `device`, drawn where the generator is; with several, a row of each.

    Noise that is given is taken as it comes.
    """
    if isinstance(generator, Iterator):
        return next(generator)
    if isinstance(generator, Sequence):
        rows = [standard_normal(shape[1:], device, own) for own in generator]
        return torch.stack(rows).view(*shape)
    drawn_on = device if generator is None else generator.device
    return torch.randn(*shape, generator=generator, device=drawn_on).to(device)


def uniform(
    count: int, device: torch.device, generator: Generator | None
) -> Float[Tensor, " {count}"]:
    """Float32 numbers in [0, 1) on `device`, drawn where the generator is."""
    drawn_on = device if generator is None else generator.device
    return torch.rand(count, generator=generator, device=drawn_on).to(device)
