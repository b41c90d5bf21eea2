"""The frozen Qwen2.5-VL: load, adapt, encode."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from pipeline.config import VLMParams
from pipeline.device import resolve_device
from pipeline.errors import NumericsError
from pipeline.vlm.checkpoint_folder import resolve_checkpoint
from pipeline.vlm.feature_spec import FeatureSpec, Slot
from pipeline.vlm.loading import environment, load_model
from pipeline.vlm.pixels import PixelSettings, patchify
from pipeline.vlm.pooling import batch_weights, pool
from pipeline.vlm.preparation import Layout, PreparedRow


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


class FrozenVLM:
    """A loaded Qwen2.5-VL that turns prepared rows into pooled features, and never learns."""

    environment: dict[str, str]
    """Attention backend, library versions and device: recorded, not part of the identity."""

    def __init__(
        self, model: Any, settings: PixelSettings, spec: FeatureSpec, device: torch.device
    ) -> None:
        """Wrap an inner `Qwen2_5_VLModel` that is already on `device`."""
        self._model = model
        self._settings = settings
        self._spec = spec
        self._device = device
        self._storage_dtype = getattr(torch, spec.document["storage_dtype"])
        # Slots repeat the same places for every (layer, norm): pooled with one set of weights.
        self._reads = tuple(dict.fromkeys((slot.layer, slot.norm) for slot in spec.slots))
        self._places: tuple[Slot, ...] = spec.slots[: len(spec.slots) // len(self._reads)]
        self._positions: dict[Layout, Int64[Tensor, "3 token"]] = {}
        self.environment = environment(model, device)

    @classmethod
    def load(cls, vlm: VLMParams, spec: FeatureSpec, device: str = "auto") -> "FrozenVLM":
        """The checkpoint (and adapter) of `vlm` in its dtype, cut after the last layer needed.

        `device` is a torch device or "auto": CUDA where there is one. Raises `VLMError` where the
        folder is incomplete, a weight is missing or left over, or the adapter does not fit.
        """
        target = resolve_device(device)
        model = load_model(vlm, max(slot.layer for slot in spec.slots) + 1, target)
        folder = resolve_checkpoint(vlm.checkpoint, vlm.revision)
        resize = (vlm.image_resize_height, vlm.image_resize_width)
        return cls(model, PixelSettings.read(folder, resize), spec, target)

    @torch.no_grad()
    def encode(
        self, rows: Sequence[PreparedRow]
    ) -> tuple[Float[Tensor, "batch slot dim"], Bool[Tensor, "batch slot"]]:
        """Features of each row in the storage dtype, and which slots are valid, both on the CPU.

        A slot whose view is missing is zero and invalid. A row is the same, within the compute
        dtype's noise, whatever rows stand beside it; rows of equal `shape_key` are fastest.
        Raises `NumericsError` naming row and slot where a feature is NaN or infinite.
        """
        batch = self._collate(rows)
        read = self._forward(batch)
        features = torch.cat([read[key] for key in self._reads], dim=1)
        features = features.to(self._storage_dtype).cpu()
        self._check_finite(features)
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
        device = self._device
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
            found, _ = self._model.get_rope_index(
                torch.zeros_like(kinds), mm_token_type_ids=kinds, image_grid_thw=grids
            )
            self._positions[layout] = found[:, 0]
        return self._positions[layout]

    def _grids(self, images: int) -> Int64[Tensor, "image 3"]:
        """Patches in time, height and width of each image."""
        return torch.tensor([(1, *self._settings.grid)] * images)

    def _forward(self, batch: _Batch) -> dict[tuple[int, bool], Float[Tensor, "batch place dim"]]:
        text = self._model.language_model
        embedded = text.embed_tokens(batch.token_ids)
        if len(batch.pixels):
            seen = self._model.visual(
                patchify(batch.pixels, self._settings).to(self._model.dtype),
                grid_thw=self._grids(len(batch.pixels)).to(self._device),
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
        text = self._model.language_model
        read: dict[tuple[int, bool], Tensor] = {}

        def pool_layer(layer: int, hidden: Tensor) -> None:
            for key in self._reads:
                if key[0] == layer:
                    tokens = text.norm(hidden) if key[1] else hidden
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

    def _check_finite(self, features: Float[Tensor, "batch slot dim"]) -> None:
        bad = ~torch.isfinite(features).all(dim=-1)
        if bool(bad.any()):
            row, slot = (int(index) for index in bad.nonzero()[0])
            raise NumericsError(
                f"row {row} of the batch, slot {self._spec.slots[slot].document()}: expected "
                f"finite features, found NaN or infinity ({int(bad.sum())} such slots of "
                f"{bad.numel()}). Computed as {self._spec.document['compute_dtype']}, stored as "
                f"{self._spec.document['storage_dtype']}: try bfloat16 or float32 for vlm.dtype "
                "and extract.dtype."
            )
