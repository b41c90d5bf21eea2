"""Encoder of a sensor window whose first channel is force."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.base.errors import ConfigError
from pipeline.policy.sensor_encoder import SensorEncoder

_FORCE_SHARE = 4


class ForceAwareSensorEncoder(nn.Module):
    """One vector for a window of normalised readings, a quarter of it from force alone.

    Shapes, masking and defaults are those of `SensorEncoder`. Channel 0 has a branch of its own, a
    quarter as wide (rounded up to whole heads) as that of the other channels, so that one channel
    among a thousand of an A-scan is not drowned; the two encoded windows stand side by side.
    Raises `ConfigError` where there is no other channel, or no room for two branches.
    """

    def __init__(
        self,
        sensor_channels: int = 1026,
        window: int = 65,
        channels: Sequence[int] = (512, 1024, 1024, 1024),
        layers: int = 2,
        heads: int = 8,
        output_dim: int = 1024,
    ) -> None:
        super().__init__()
        if min(sensor_channels, output_dim) < 2:
            raise ConfigError(
                "train_head.sensor_encoder.kind force_aware: expected force, at least one other "
                "channel and an output_dim of at least 2, found "
                f"{sensor_channels} channel(s) and output_dim {output_dim}. Use kind: joint."
            )
        narrow = [heads * -(-width // (_FORCE_SHARE * heads)) for width in channels]
        force_dim = -(-output_dim // _FORCE_SHARE)
        self.force = SensorEncoder(1, window, narrow, layers, heads, force_dim)
        self.scan = SensorEncoder(
            sensor_channels - 1, window, channels, layers, heads, output_dim - force_dim
        )

    def forward(
        self,
        values: Float[Tensor, "batch window channel"],
        valid: Int[Tensor, " batch"] | None = None,
    ) -> Float[Tensor, "batch output"]:
        """Encode; `valid` None means that every reading is real."""
        force, scan = values[..., :1], values[..., 1:]
        return torch.cat([self.force(force, valid), self.scan(scan, valid)], dim=-1)
