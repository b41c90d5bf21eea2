"""Encoders of the streams: a token for each slot of features, a vector for a window of readings.

The high-rate sensor passes residual stride-2 convolutions and the state strided patches; then each
passes a transformer.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.base.config import FeatureEncoderParams, TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.policy.ages import AgeEncoder, at_even_ages, even_ages
from pipeline.policy.attention import (
    Attention,
    TransformerLayer,
    learned,
    masked_mean,
    right_aligned,
)
from pipeline.policy.shape import PolicyShape

_KIND_STD = 0.3
"""Initial std of what all keys of a view or pooling share: at 1 it drowned what a slot shows."""
_SHARPNESS = 4.0
"""Initial scale of what a query asks: at 1 it attends to all slots alike, and learns more slowly
to look at one."""
_OCTAVES = 5
"""Wavelengths of a place: from twice the view's side to an eighth of it."""
_FORCE_SHARE = 4
"""`ForceAwareSensorEncoder` gives force one part in so many of an encoded window."""


class FeatureEncoder(nn.Module):
    """Normalised features (batch, slot, dim) and their ages to tokens (batch, slot, width).

    All slots share one projection to `width`, so the cost is dim·width a slot; each slot has a
    learned embedding, so grid cells are told apart. The ages in s, of the newest frame and of that
    of each view, are encoded and added to every token. A slot that is not valid becomes another
    learned embedding, without an age.
    """

    def __init__(
        self, slots: int, feature_dim: int, width: int | None = None, views: int = 0
    ) -> None:
        super().__init__()
        self.slots = slots
        # Few slots carry much each: 512 wide for a single mean, 64 for a grid cell.
        self.width = width or min(feature_dim, max(64, 512 // slots))
        self.squeeze = nn.Linear(feature_dim, self.width)
        self.slot = learned(slots, self.width)
        self.missing = learned(slots, self.width)
        self.norm = nn.LayerNorm(self.width)
        self.age = AgeEncoder(1 + views, self.width)

    def forward(
        self,
        features: Float[Tensor, "batch slot dim"],
        slot_valid: Bool[Tensor, "batch slot"],
        age_s: Float[Tensor, " batch"],
        view_age_s: Float[Tensor, "batch view"] | None = None,
        state: Float[Tensor, "batch 1 _"] | None = None,
    ) -> Float[Tensor, "batch slot width"]:
        """Encode; the content of a slot that is not valid reaches neither output nor gradients.

        Nor do the ages of a sample without a valid slot. The age of a missing view is NaN.
        """
        absent = ~slot_valid.unsqueeze(-1)
        slots = self.squeeze(features.masked_fill(absent, 0.0)) + self.slot
        slots = torch.where(absent, self.missing.to(slots.dtype), slots)
        slots = nn.functional.gelu(self.norm(slots), approximate="tanh")
        ages = known_ages(slot_valid, age_s, view_age_s)
        return slots + self.age(ages).unsqueeze(1).masked_fill(absent, 0.0)


class MeanFeatureEncoder(FeatureEncoder):
    """As `FeatureEncoder`, of one slot a layer and row: the mean of its valid slots."""

    def __init__(self, layers: int, feature_dim: int, views: int = 0) -> None:
        super().__init__(layers, feature_dim, views=views)

    def forward(
        self,
        features: Float[Tensor, "batch slot dim"],
        slot_valid: Bool[Tensor, "batch slot"],
        age_s: Float[Tensor, " batch"],
        view_age_s: Float[Tensor, "batch view"] | None = None,
        state: Float[Tensor, "batch 1 _"] | None = None,
    ) -> Float[Tensor, "batch layer width"]:
        """Encode, as `FeatureEncoder.forward`."""
        valid = slot_valid.unflatten(1, (self.slots, -1))
        means = masked_mean(
            features.unflatten(1, valid.shape[1:]).flatten(0, 1), valid.flatten(0, 1)
        )
        means = means.unflatten(0, valid.shape[:2])
        return super().forward(means, valid.any(dim=-1), age_s, view_age_s)


class SlotAttention(nn.Module):
    """Tokens take from the keys what they ask for; then a feed-forward network."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.attention = Attention(dim, heads)
        nn.init.normal_(self.attention.query.weight, std=_SHARPNESS * (3 * dim) ** -0.5)
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(dim),
            nn.Linear(dim, 4 * dim),
            nn.GELU(approximate="tanh"),
            nn.Linear(4 * dim, dim),
        )

    def forward(
        self,
        tokens: Float[Tensor, "batch query dim"],
        keys: Float[Tensor, "batch slot dim"],
        valid: Bool[Tensor, "batch slot"],
        steer: Float[Tensor, "batch 1 dim"] | float = 0.0,
    ) -> Float[Tensor, "batch query dim"]:
        """The tokens after this layer; `steer` is added to what they ask, not to what they are."""
        tokens = tokens + self.attention(self.norm(tokens) + steer, keys, valid)
        return tokens + self.feed_forward(tokens)


class FeaturePooler(nn.Module):
    """Learned queries that attend to the slots: features (batch, slot, dim) -> (batch, query, dim).

    The slots of a place in all layers of a row become one key, by a learned mixture of the layers.
    Layers have no embedding: it would add the same to every key, as the bias of `squeeze` does.
    A key knows its row and where in which view it looks, by Fourier features of its cell's centre
    (Tancik et al. 2020) and embeddings of view and pooling, so that parameters do not grow with the
    number of slots. Keys without a valid slot are masked. The state moves the queries through a
    gate that is 0 at first: it directs where they look, but the values are of the slots alone.
    """

    index: Int[Tensor, "place 2"]
    waves: Float[Tensor, "place wave"]

    def __init__(self, shape: PolicyShape, params: FeatureEncoderParams, state_dim: int) -> None:
        super().__init__()
        places, dim = shape.places, params.dim
        self.rows_and_layers = shape.history, shape.layers
        self.mixture = nn.Parameter(torch.zeros(shape.layers))
        self.squeeze = nn.Linear(shape.feature_dim, dim)
        kinds = [
            sorted({place.pooling for place in places}),
            sorted({p.view or "" for p in places}),
        ]
        sizes = (shape.history, *map(len, kinds))
        self.row, *of_kinds = (nn.Embedding(size, dim) for size in sizes)
        for embedding in (self.row, *of_kinds):
            nn.init.normal_(embedding.weight, std=_KIND_STD)
        self.kinds = nn.ModuleList(of_kinds)
        index = [[kinds[0].index(p.pooling), kinds[1].index(p.view or "")] for p in places]
        centers = torch.tensor([p.center or (0.5, 0.5) for p in places])
        waves = centers[..., None] * torch.pi * 2 ** torch.arange(_OCTAVES)
        waves = torch.cat([waves.sin(), waves.cos()], dim=-1).flatten(1)
        self.register_buffer("index", torch.tensor(index), persistent=False)
        self.register_buffer("waves", waves, persistent=False)
        self.where = nn.Linear(waves.shape[1], dim)
        self.queries = learned(params.queries, dim)
        self.steer = nn.Linear(state_dim, dim) if state_dim else None
        self.gate = nn.Parameter(torch.zeros(dim))
        self.reads = nn.ModuleList(SlotAttention(dim, params.heads) for _ in range(params.layers))
        self.key_norm, self.norm = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.missing = learned(params.queries, dim)
        self.age = AgeEncoder(1 + shape.views, dim)

    def forward(
        self,
        features: Float[Tensor, "batch slot dim"],
        slot_valid: Bool[Tensor, "batch slot"],
        age_s: Float[Tensor, " batch"],
        view_age_s: Float[Tensor, "batch view"] | None = None,
        state: Float[Tensor, "batch 1 _"] | None = None,
    ) -> Float[Tensor, "batch query width"]:
        """Encode; nothing of a slot that is not valid reaches the output or a gradient."""
        features = features.masked_fill(~slot_valid.unsqueeze(-1), 0.0)
        by_layer = (*self.rows_and_layers, -1)
        mixed = torch.einsum(
            "brlpd,l->brpd", features.unflatten(1, by_layer), self.mixture.softmax(dim=0)
        )
        place = self.where(self.waves)
        for embedding, index in zip(self.kinds, self.index.T, strict=True):
            place = place + embedding(index)
        place = place + self.row.weight.unsqueeze(1)
        keys = self.key_norm(self.squeeze(mixed) + place).flatten(1, 2)
        present = slot_valid.unflatten(1, by_layer).any(dim=2).flatten(1)
        missing = ~present.any(dim=1, keepdim=True)
        steer = 0.0
        if self.steer is not None and state is not None:
            steer = self.gate * self.steer(state)
        tokens = self.queries.expand(features.shape[0], -1, -1)  # len() would fix it in an export
        for read in self.reads:
            # A row without any slot attends to what it lacks: softmax over nothing is NaN.
            tokens = read(tokens, keys, present | missing, steer)
        ages = self.age(known_ages(slot_valid, age_s, view_age_s)).unsqueeze(1)
        return torch.where(missing.unsqueeze(-1), self.missing, self.norm(tokens) + ages)


def known_ages(
    slot_valid: Bool[Tensor, "batch slot"],
    age_s: Float[Tensor, " batch"],
    view_age_s: Float[Tensor, "batch view"] | None,
) -> Float[Tensor, "batch age"]:
    """The ages of the newest frame and of each view; NaN where a sample has no valid slot."""
    ages = age_s[:, None]
    if view_age_s is not None:
        ages = torch.cat([ages, view_age_s], dim=1)
    return ages.masked_fill(~slot_valid.any(dim=1, keepdim=True), torch.nan)


class HalvingBlock(nn.Module):
    """A residual block that halves time: y = down(x), then y + conv(gelu(norm(y))).

    `down` is a convolution of kernel 2 and stride 2, computed as one matrix product over the
    untransposed input: with 1,026 channels in, a fifth of the time of kernel 3 on a CPU. Pairs are
    counted from the right, where the tick is. Steps that are not valid stay zero throughout.
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.down = nn.Linear(2 * channels_in, channels_out)
        self.norm = nn.LayerNorm(channels_out)
        self.conv = nn.Conv1d(channels_out, channels_out, kernel_size=3, padding=1)

    def forward(
        self, values: Float[Tensor, "batch time channel"], valid: Bool[Tensor, "batch time"]
    ) -> tuple[Float[Tensor, "batch half out"], Bool[Tensor, "batch half"]]:
        """The block's output and which of its steps saw at least one valid step."""
        if values.shape[1] % 2:
            values, valid = F.pad(values, (0, 0, 1, 0)), F.pad(valid, (1, 0))
        valid = valid.unflatten(1, (-1, 2)).any(dim=-1)
        absent = ~valid.unsqueeze(-1)
        halved = self.down(values.unflatten(1, (-1, 2)).flatten(2))
        branch = F.gelu(self.norm(halved), approximate="tanh").masked_fill(absent, 0.0)
        branch = self.conv(branch.transpose(1, 2)).transpose(1, 2)
        return (halved + branch).masked_fill(absent, 0.0), valid


class WindowEncoder(nn.Module):
    """The part that the encoders of windows share: readings placed by age, a transformer, a mean.

    Windows are right-aligned: the last `valid[i]` readings of row i are real, the rest is padding
    that never reaches the output. Where `valid[i]` is 0, the output is a learned embedding.
    Readings are placed by their ages (batch, window) in s on `window` steps of equal age that span
    `span_s`; without a span or ages they count as evenly spread. The newest age is an input.
    """

    window: int
    span_s: float | None

    def tokenize(
        self, values: Float[Tensor, "batch step channel"], mask: Bool[Tensor, "batch step"]
    ) -> tuple[Float[Tensor, "batch token dim"], Bool[Tensor, "batch token"]]:
        """The window's tokens, and which of them have a reading; `mask` says it of the steps."""
        raise NotImplementedError

    def place(
        self,
        values: Float[Tensor, "batch reading channel"],
        valid: Int[Tensor, " batch"],
        age_s: Float[Tensor, "batch reading"] | None,
    ) -> tuple[Float[Tensor, "batch step channel"], Bool[Tensor, "batch step"]]:
        """The readings resampled at the encoder's steps, and which steps have a reading."""
        mask, span_s = right_aligned(valid, values.shape[1]), self.span_s or 1.0
        if age_s is None or self.span_s is None:
            if values.shape[1] == self.window:
                return values, mask
            age_s = even_ages(values.shape[1], span_s, mask).expand(mask.shape)
        return at_even_ages(values, mask, age_s, self.window, span_s)

    def build_layers(
        self, tokens: int, dim: int, layers: int, heads: int, expansion: int, output_dim: int
    ) -> None:
        """Draw the weights that follow the tokens; call it after the weights of the tokens."""
        self.position = learned(tokens, dim)
        self.layers = nn.ModuleList(TransformerLayer(dim, heads, expansion) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)
        self.project = nn.Linear(dim, output_dim)
        self.age = AgeEncoder(1, output_dim)
        self.missing = learned(output_dim)

    def forward(
        self,
        values: Float[Tensor, "batch reading channel"],
        valid: Int[Tensor, " batch"] | None = None,
        age_s: Float[Tensor, "batch reading"] | None = None,
    ) -> Float[Tensor, "batch output"]:
        """Encode; `valid` None means that every reading is real."""
        if valid is None:
            valid = torch.full((len(values),), values.shape[1], device=values.device)
        tokens, present = self.tokenize(*self.place(values, valid, age_s))
        missing = (valid == 0).unsqueeze(-1)
        tokens = tokens + self.position
        # A row without any reading attends to zeros: softmax over nothing is NaN on some devices.
        attended = present | missing
        for layer in self.layers:
            tokens = layer(tokens, attended)
        encoded = self.project(masked_mean(self.norm(tokens), present))
        newest = age_s[:, -1:] if age_s is not None else encoded.new_zeros(encoded.shape[0], 1)
        encoded = encoded + self.age(newest.masked_fill(missing, 0.0))
        return torch.where(missing, self.missing.to(encoded.dtype), encoded)


class SensorEncoder(WindowEncoder):
    """One vector for a window of normalised readings of any channels.

    Shapes (batch, window, channel) -> (batch, output_dim).
    """

    def __init__(
        self,
        sensor_channels: int = 1026,
        window: int = 65,
        channels: Sequence[int] = (512, 1024, 1024, 1024),
        layers: int = 2,
        heads: int = 8,
        output_dim: int = 1024,
        span_s: float | None = 0.1,
    ) -> None:
        super().__init__()
        self.window, self.span_s = window, span_s
        widths = (sensor_channels, *channels)
        self.blocks = nn.ModuleList(HalvingBlock(*pair) for pair in pairwise(widths))
        tokens = window
        for _ in channels:
            tokens = (tokens + 1) // 2
        self.build_layers(tokens, widths[-1], layers, heads, 2, output_dim)

    def tokenize(
        self, values: Float[Tensor, "batch step channel"], mask: Bool[Tensor, "batch step"]
    ) -> tuple[Float[Tensor, "batch token dim"], Bool[Tensor, "batch token"]]:
        """The output of the last block, for a copy of the window with zeros where no reading is.

        The same copy gets a step in front of an odd number of steps: the windows are the largest
        tensors of a training step, so they are copied once.
        """
        odd = values.shape[1] % 2
        front = values.new_zeros(values.shape[0], odd, values.shape[2])
        values, mask = torch.cat([front, values], dim=1), F.pad(mask, (odd, 0))
        values.masked_fill_(~mask.unsqueeze(-1), 0.0)
        for block in self.blocks:
            values, mask = block(values, mask)
        return values, mask


class ForceAwareSensorEncoder(nn.Module):
    """One vector for a window of normalised readings, a quarter of it from force alone.

    Shapes, masking and defaults are those of `SensorEncoder`. Force, channel 0, has a branch of its
    own, a quarter as wide (rounded up to whole heads) as the branch of the other channels, so that
    the thousand channels of an A-scan do not drown it. The output joins both encoded windows.
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
        span_s: float | None = 0.1,
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
        self.force = SensorEncoder(1, window, narrow, layers, heads, force_dim, span_s)
        self.scan = SensorEncoder(
            sensor_channels - 1, window, channels, layers, heads, output_dim - force_dim, span_s
        )

    def forward(
        self,
        values: Float[Tensor, "batch window channel"],
        valid: Int[Tensor, " batch"] | None = None,
        age_s: Float[Tensor, "batch window"] | None = None,
    ) -> Float[Tensor, "batch output"]:
        """Encode; `valid` None means that every reading is real."""
        force, scan = values[..., :1], values[..., 1:]
        return torch.cat([self.force(force, valid, age_s), self.scan(scan, valid, age_s)], dim=-1)


class RobotStateEncoder(WindowEncoder):
    """One vector for a window of normalised robot states (6 joints and a pose: 12 wide).

    Shapes (batch, window, dim) -> (batch, output_dim). `patch` readings make one token (10 at
    100 Hz are one 10 Hz tick), a tenth of the cost of a token for each reading. The input of a
    patch also says which of its readings are real.
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
        span_s: float | None = 1.0,
    ) -> None:
        super().__init__()
        self.patch, self.window, self.span_s = patch, window, span_s
        self.embed = nn.Linear(patch * (state_dim + 1), dim)
        self.build_layers(-(-window // patch), dim, layers, heads, 4, output_dim)

    def tokenize(
        self, values: Float[Tensor, "batch step channel"], mask: Bool[Tensor, "batch step"]
    ) -> tuple[Float[Tensor, "batch token dim"], Bool[Tensor, "batch token"]]:
        """The embedded patches."""
        short = -values.shape[1] % self.patch
        mask = F.pad(mask, (short, 0)).unsqueeze(-1)
        values = F.pad(values, (0, 0, short, 0)).masked_fill(~mask, 0.0)
        values = torch.cat([values, mask.to(values.dtype)], dim=-1)
        present = mask.squeeze(-1).unflatten(1, (-1, self.patch)).any(dim=-1)
        return self.embed(values.unflatten(1, (-1, self.patch)).flatten(2)), present


SENSOR_ENCODERS: dict[str, type[SensorEncoder] | type[ForceAwareSensorEncoder]] = {
    "joint": SensorEncoder,
    "force_aware": ForceAwareSensorEncoder,
}
"""The class of each `train_head.sensor_encoder.kind`."""


def build_feature_encoder(
    params: FeatureEncoderParams, shape: PolicyShape, state_dim: int
) -> FeatureEncoder | FeaturePooler:
    """The encoder of this kind; `state_dim` is the width of the state's token, 0 for none.

    Raises `ConfigError` where the shape does not say which slots are of one layer.
    """
    if params.kind == "linear":
        slots = shape.slots * shape.history
        return FeatureEncoder(slots, shape.feature_dim, views=shape.views)
    if not shape.places:
        raise ConfigError(
            f"train_head.feature_encoder.kind {params.kind}: expected to know the layer and place "
            "of each slot, which only a store says. Train from a store, or use kind: linear."
        )
    if params.kind == "mean":
        return MeanFeatureEncoder(shape.layers * shape.history, shape.feature_dim, shape.views)
    return FeaturePooler(shape, params, state_dim)


def build_encoders(
    params: TrainHeadParams, shape: PolicyShape
) -> tuple[nn.ModuleDict, dict[str, tuple[int, int]]]:
    """Encoders of the streams both present and enabled, and how many tokens of what width each.

    Raises `ConfigError` where no stream is left.
    """
    encoders, tokens = nn.ModuleDict(), dict[str, tuple[int, int]]()
    if params.features_enabled and shape.slots and shape.feature_dim:
        state_dim = params.state_encoder.output_dim
        steered = params.feature_encoder.state and params.robot_state_enabled and shape.state_dim
        features = build_feature_encoder(params.feature_encoder, shape, state_dim if steered else 0)
        encoders["features"] = features
        pooled = params.feature_encoder
        tokens["features"] = (
            (pooled.queries, pooled.dim)
            if isinstance(features, FeaturePooler)
            else (features.slots, features.width)
        )
    if params.sensor_enabled and shape.sensor_channels:
        sensor = params.sensor_encoder
        encoders["sensor"] = SENSOR_ENCODERS[sensor.kind](
            shape.sensor_channels,
            params.sensor_window,
            span_s=params.sensor_window_s,
            **sensor.model_dump(exclude={"kind"}),
        )
        tokens["sensor"] = (1, sensor.output_dim)
    if params.robot_state_enabled and shape.state_dim:
        state = params.state_encoder
        encoders["state"] = RobotStateEncoder(
            shape.channels["state"][0],
            params.state_window,
            span_s=params.state_window_s,
            **state.model_dump(),
        )
        tokens["state"] = (1, state.output_dim)
    if not tokens:
        raise ConfigError(
            "the policy has nothing to look at: the store has "
            f"{shape.slots} feature slots, {shape.sensor_channels} sensor channels and "
            f"{shape.state_dim} state channels. Enable one of these in train_head "
            "(features_enabled, sensor_enabled, robot_state_enabled)."
        )
    return encoders, tokens
