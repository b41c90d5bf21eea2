"""Encoder of the robot-state window: strided patches, then a transformer."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.policy.attention import TransformerLayer, learned, masked_mean, right_aligned


class RobotStateEncoder(nn.Module):
    """One vector for a window of normalised robot states (6 joints and a pose: 12 wide).

    Shapes (batch, window, dim) -> (batch, output_dim). `patch` readings make one token (10 at
    100 Hz are one 10 Hz tick), which costs a tenth of a token a reading. Windows are right-aligned:
    the last `valid[i]` of row i are readings; padding never reaches the output, and each patch is
    told which of its readings are real. Where `valid[i]` is 0 the output is a learned embedding.
    """

    def __init__(
        self,
        state_dim: int = 12,
        window: int = 100,
        dim: int = 256,
        layers: int = 2,
        heads: int = 8,
        output_dim: int = 512,
        patch: int = 10,
    ) -> None:
        super().__init__()
        self.patch = patch
        self.embed = nn.Linear(patch * (state_dim + 1), dim)
        self.position = learned(-(-window // patch), dim)
        self.layers = nn.ModuleList(TransformerLayer(dim, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)
        self.project = nn.Linear(dim, output_dim)
        self.missing = learned(output_dim)

    def forward(
        self, values: Float[Tensor, "batch window dim"], valid: Int[Tensor, " batch"] | None = None
    ) -> Float[Tensor, "batch output"]:
        """Encode; `valid` None means that every reading is real."""
        batch, window, _ = values.shape
        if valid is None:
            valid = torch.full((batch,), window, device=values.device)
        short = -window % self.patch
        mask = right_aligned(valid, window + short).unsqueeze(-1)
        values = F.pad(values, (0, 0, short, 0)).masked_fill(~mask, 0.0)
        values = torch.cat([values, mask.to(values.dtype)], dim=-1)
        present = mask.squeeze(-1).unflatten(1, (-1, self.patch)).any(dim=-1)
        missing = (valid == 0).unsqueeze(-1)
        # A row without any reading attends to zeros: softmax over nothing is NaN on some devices.
        attended = present | missing
        tokens = self.embed(values.unflatten(1, (-1, self.patch)).flatten(2)) + self.position
        for layer in self.layers:
            tokens = layer(tokens, attended)
        encoded = self.project(masked_mean(self.norm(tokens), present))
        return torch.where(missing, self.missing.to(encoded.dtype), encoded)
