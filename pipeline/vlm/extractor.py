"""Prepared rows -> pooled features, differentiable: what the frozen and the live model share."""

from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from pipeline.vlm.pixels import PixelSettings, patchify
from pipeline.vlm.pooling import batch_weights, pool
from pipeline.vlm.preparation import Layout, PreparedRow
from pipeline.vlm.slots import Slot


@dataclass(frozen=True)
class _Batch:
    """Rows side by side, padded on the right, on the model's device."""

    token_ids: Int64[Tensor, "batch token"]
    real: Bool[Tensor, "batch token"] | None
    """Which tokens are not padding; None where none is."""
    positions: Int64[Tensor, "3 batch token"]
    pixels: UInt8[Tensor, "image height width 3"]
    image_tokens: Int64[Tensor, " image_token"]
    """Indices of the image tokens in the flattened (batch x token)."""
    weights: Float[Tensor, "batch place token"]
    valid: Bool[Tensor, "batch place"]
    """Which places have a token at all; on the CPU."""


def layers_needed(slots: Iterable[Slot]) -> int:
    """How many decoder layers must run for these slots."""
    return max(slot.layer for slot in slots) + 1


class Extractor:
    """Collates rows, runs an inner `Qwen2_5_VLModel` and pools what its layers give.

    Whether gradients flow, and in which precision, is the caller's.
    """

    def __init__(self, model: Any, settings: PixelSettings, slots: tuple[Slot, ...]) -> None:
        """`model` may be cut after the last layer that a slot reads."""
        self.model = model
        self._settings = settings
        # Slots repeat the same places for every (layer, norm): pooled with one set of weights.
        self._reads = tuple(dict.fromkeys((slot.layer, slot.norm) for slot in slots))
        self._places: tuple[Slot, ...] = slots[: len(slots) // len(self._reads)]
        self._positions: dict[Layout, Int64[Tensor, "3 token"]] = {}

    def extract(
        self, rows: Sequence[PreparedRow]
    ) -> tuple[Float[Tensor, "batch slot dim"], Bool[Tensor, "batch slot"]]:
        """Features of each row in float32 on the model's device; which are valid, on the CPU."""
        batch = self._collate(rows)
        read = self._forward(batch)
        features = torch.cat([read[key] for key in self._reads], dim=1)
        return features, batch.valid.repeat(1, len(self._reads))

    def _collate(self, rows: Sequence[PreparedRow]) -> _Batch:
        layouts = [row.layout for row in rows]
        length = max(layout.length for layout in layouts)
        token_ids = torch.zeros(len(rows), length, dtype=torch.int64)
        real = torch.zeros(len(rows), length, dtype=torch.bool)
        positions = torch.zeros(3, len(rows), length, dtype=torch.int64)
        for index, row in enumerate(rows):
            filled = slice(0, row.layout.length)
            token_ids[index, filled] = torch.tensor(row.token_ids)
            real[index, filled] = True
            positions[:, index, filled] = self._rope_positions(row.layout)
        image_tokens = np.concatenate(
            [index * length + layout.image_tokens() for index, layout in enumerate(layouts)]
        )
        weights = batch_weights(self._places, layouts, length)
        device = self.model.device
        return _Batch(
            token_ids.to(device),
            None if bool(real.all()) else real.to(device),
            positions.to(device),
            torch.from_numpy(np.concatenate([row.pixels for row in rows])).to(device),
            torch.from_numpy(image_tokens).to(device),
            weights.to(device),
            (weights != 0).any(dim=-1),
        )

    def _rope_positions(self, layout: Layout) -> Int64[Tensor, "3 token"]:
        """Time, height and width position of each token; computed once a layout, on the CPU."""
        if layout not in self._positions:
            kinds = torch.zeros(1, layout.length, dtype=torch.int64)
            kinds[0, torch.from_numpy(layout.image_tokens())] = 1
            grids = self._grids(len(layout.image_starts)) if layout.image_starts else None
            found, _ = self.model.get_rope_index(
                torch.zeros_like(kinds), mm_token_type_ids=kinds, image_grid_thw=grids
            )
            self._positions[layout] = found[:, 0]
        return self._positions[layout]

    def _grids(self, images: int) -> Int64[Tensor, "image 3"]:
        """Patches in time, height and width of each image."""
        return torch.tensor([(1, *self._settings.grid)] * images)

    def _forward(self, batch: _Batch) -> dict[tuple[int, bool], Float[Tensor, "batch place dim"]]:
        text = self.model.language_model
        embedded = text.embed_tokens(batch.token_ids)
        if len(batch.pixels):
            seen = self.model.visual(
                patchify(batch.pixels, self._settings).to(self.model.dtype),
                grid_thw=self._grids(len(batch.pixels)).to(self.model.device),
            ).pooler_output
            embedded.flatten(0, 1).index_copy_(0, batch.image_tokens, seen.to(embedded.dtype))
        with self._reading(batch) as read:
            # Attention is causal and padding stands last, so no real token sees any: a mask would
            # only cost its memory and the fast causal kernel.
            text(inputs_embeds=embedded, position_ids=batch.positions, use_cache=False)
        return read

    @contextmanager
    def _reading(self, batch: _Batch) -> Generator[dict[tuple[int, bool], Tensor]]:
        """Pool what each layer gives as soon as it gives it, so that no layer is kept alive."""
        text = self.model.language_model
        read: dict[tuple[int, bool], Tensor] = {}

        def pool_layer(layer: int, hidden: Tensor) -> None:
            for key in self._reads:
                if key[0] == layer:
                    tokens = text.norm(hidden) if key[1] else hidden
                    # Sums over thousands of tokens stay in float32 whatever the caller's autocast.
                    with torch.autocast(tokens.device.type, enabled=False):
                        read[key] = pool(tokens, batch.weights, batch.real)

        hooks = [
            text.layers[layer].register_forward_hook(
                lambda _module, _inputs, hidden, layer=layer: pool_layer(layer, hidden)
            )
            for layer in sorted({layer for layer, _ in self._reads})
        ]
        try:
            yield read
        finally:
            for hook in hooks:
                hook.remove()
