"""What to do when an episode is over: nothing, held still."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.policy.observation import action_groups
from pipeline.store import FeatureStore


class TerminalStop:
    """The action chunk beyond an episode's end, as something to learn instead of to leave out.

    A robot that is to stand still moves by zero: so deltas and velocities become 0, save a
    gripper's, which is a position in every format and keeps its last value. Absolute actions
    repeat the last one.
    """

    def __init__(self, store: FeatureStore, device: torch.device) -> None:
        action = store.streams["action"]
        absolute = action["kind"] == "absolute"
        kept = [absolute or g == "gripper" for g in action_groups(action["names"], action["units"])]
        self._kept = torch.tensor(kept, device=device)

    def extend(
        self, action: Float[Tensor, "batch horizon action"], valid: Bool[Tensor, "batch horizon"]
    ) -> tuple[Float[Tensor, "batch horizon action"], Bool[Tensor, "batch horizon"]]:
        """The chunk and what of it counts: everything.

        The store repeats the last action beyond the end, so what is kept is there already.
        """
        counted = valid.unsqueeze(-1) | self._kept
        return action.masked_fill(~counted, 0.0), torch.ones_like(valid)
