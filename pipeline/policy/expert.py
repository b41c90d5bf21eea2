"""The contract of an action expert: its tensors, its guide, its noise and its grouped loss."""

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
"""The source of a batch's noise: one generator for the batch, one for each sample, the device's own
(None), or the noise itself, in the order in which a sampler takes it."""
ErrorKind = Literal["smooth_l1", "mse"]


@dataclass(frozen=True)
class Guide:
    """The chunk to continue, and the weight of each of its steps, from 0 to 1.

    A step of weight 0 changes nothing, whatever finite values it holds.
    """

    chunk: Chunk
    weight: Float[Tensor, "batch horizon"]

    def repeat(self, times: int) -> "Guide":
        """The guide of a batch repeated as a whole."""
        return Guide(self.chunk.repeat(times, 1, 1), self.weight.repeat(times, 1))


class ActionExpert(nn.Module, ABC):
    """Turns a context into an action chunk; all actions are in normalised units.

    `loss` sees the recorded chunk, `act` never does: an expert that predicts directly computes its
    prediction in a function of the context alone and uses it in both. A `stochastic` expert draws
    its chunks, and everything random in its loss except dropout, from the generator that is passed,
    on the generator's device, or from the global generator of the context's device.
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
        """`groups` names the loss group of each action channel; with None all are `other`."""
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

        Only a `stochastic` expert takes a guide: a chunk to continue, in normalised units.
        """


class GroupedLoss(nn.Module):
    """An error averaged over the valid entries of each action group.

    The error of an entry is smooth-L1 (Girshick 2015, eq. 3) or squared (`mse`). The total is the
    mean of the groups under `weights` (1 where not named): three rotation channels count as much as
    three hundred, and the total does not grow with the number of groups. Raises `ConfigError` where
    no group has weight.
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


def standard_normal(
    shape: Sequence[int], device: torch.device, generator: Generators
) -> Float[Tensor, "..."]:
    """Float32 noise on `device`, drawn on the generator's device.

    Several generators draw a row each; an iterator gives the noise itself.
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
