"""The contract of an action expert, and the loss over groups of action channels."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.errors import ConfigError


class ActionExpert(nn.Module, ABC):
    """Context in, action chunk out; all actions are normalised units.

    `loss` sees the recorded chunk, `act` never does: an expert that predicts directly must form
    its prediction in a function that takes the context alone, and use it in both.
    """

    horizon: int
    action_dim: int

    @abstractmethod
    def loss(
        self,
        context: Float[Tensor, "batch token dim"],
        actions: Float[Tensor, "batch horizon action"],
        valid: Bool[Tensor, "batch horizon"],
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """The scalar to minimise and its detached parts by name; masked steps count nothing."""

    @abstractmethod
    def act(
        self, context: Float[Tensor, "batch token dim"], generator: torch.Generator | None = None
    ) -> Float[Tensor, "batch horizon action"]:
        """A chunk; the same for the same context and generator state."""


class GroupedLoss(nn.Module):
    """Smooth-L1 (Girshick 2015, eq. 3), averaged over the valid entries of each action group.

    The total is the mean of the groups under `weights` (1 where not named): three rotation
    channels count as much as three hundred, and the total does not grow with the groups. Raises
    `ConfigError` where no group has weight.
    """

    membership: Tensor
    weights: Tensor

    def __init__(self, groups: Sequence[str], weights: Mapping[str, float]) -> None:
        super().__init__()
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

    def forward(
        self,
        prediction: Float[Tensor, "batch horizon action"],
        target: Float[Tensor, "batch horizon action"],
        valid: Bool[Tensor, "batch horizon"],
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """The weighted mean over the groups, and each group's own mean, detached."""
        mask = valid.unsqueeze(-1)
        target = target.masked_fill(~mask, 0.0)
        error = F.smooth_l1_loss(prediction.float(), target.float(), reduction="none")
        per_channel = error.masked_fill(~mask, 0.0).sum(dim=(0, 1))
        entries = valid.sum() * self.membership.sum(dim=1)
        means = (self.membership * per_channel).sum(dim=1) / entries.clamp(min=1)
        parts = dict(zip(self.names, means.detach().unbind(), strict=True))
        return (means * self.weights).sum(), parts
