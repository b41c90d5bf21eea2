"""Prepared rows -> pooled features, differentiable; shared by the frozen and the live model."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from transformers.masking_utils import create_causal_mask, create_sliding_window_causal_mask

from pipeline.vlm.collation import Collator, TokenBatch
from pipeline.vlm.pooling import pool
from pipeline.vlm.preparation import PreparedRow
from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.slots import Slot
from pipeline.vlm.vision import VisionTower

_SHAPES = 64
"""Most batch shapes that are compiled: tried sizes times prompt lengths times views."""


def layers_needed(slots: Iterable[Slot]) -> int:
    """How many decoder layers must run for these slots."""
    return max(slot.layer for slot in slots) + 1


class Extractor:
    """Collates rows, runs an inner `Qwen2_5_VLModel` and pools its layers' outputs.

    The caller decides whether gradients flow, and in which precision. Nothing waits for the device
    between a batch's first tensor and its features.
    """

    def __init__(
        self,
        model: Any,
        settings: PixelSettings,
        slots: tuple[Slot, ...],
        compiled: bool = False,
    ) -> None:
        """`model` may be cut after the last layer that a slot reads.

        With `compiled`, vision and text are each compiled completely, for static shapes.
        """
        self.model = model
        self._settings = settings
        # Every (layer, norm) has the same places, so one set of pooling weights is enough.
        self._reads = tuple(dict.fromkeys((slot.layer, slot.norm) for slot in slots))
        places = slots[: len(slots) // len(self._reads)]
        self._tower = VisionTower(model.visual, settings.grid)
        self._collator = Collator(model, settings, places, self._tower, static=compiled)
        self._compiled: tuple[Callable[..., Tensor], ...] = ()
        if compiled:
            from torch._dynamo import config  # takes a second to import

            # After more shapes than this, dynamo would continue uncompiled, almost silently.
            config.recompile_limit = _SHAPES
            mode = "reduce-overhead" if model.device.type == "cuda" else None
            parts = (self._tower.__call__, self._read)
            self._compiled = tuple(torch.compile(p, dynamic=False, mode=mode) for p in parts)

    def extract(
        self, rows: Sequence[PreparedRow]
    ) -> tuple[Float[Tensor, "batch slot dim"], Bool[Tensor, "batch slot"]]:
        """Features of each row, float32 on the model's device, and which are valid, on the CPU."""
        batch = self.collate(rows)
        return self.features(batch), self.valid(batch)

    def collate(self, rows: Sequence[PreparedRow]) -> TokenBatch:
        """The batch for `features`, sent to the model's device without waiting."""
        return self._collator.collate(rows)

    def valid(self, batch: TokenBatch) -> Bool[Tensor, "batch slot"]:
        """Which slots have at least one token; on the CPU."""
        return batch.arrangement.valid.repeat(1, len(self._reads))

    def features(self, batch: TokenBatch) -> Float[Tensor, "batch slot dim"]:
        """The slots of each row, in float32 on the model's device.

        A compiled extractor overwrites its result with its next batch.
        """
        if self._compiled:
            torch.compiler.cudagraph_mark_step_begin()
        see, read = self._compiled or (self._tower, self._read)
        places = batch.arrangement
        embedded = self.model.language_model.embed_tokens(batch.token_ids)
        if batch.plan is not None:
            patches = patchify(batch.pixels, self._settings).to(self.model.dtype)
            seen = see(patches, batch.plan).index_select(0, batch.shown)
            embedded.flatten(0, 1).index_copy_(0, places.image_tokens, seen.to(embedded.dtype))
        masks = self._masks(embedded)
        return read(embedded, places.positions, masks, places.weights, places.real)

    def _masks(self, embedded: Float[Tensor, "batch token dim"]) -> Mapping[str, Tensor | None]:
        """The mask of each kind of layer; None where the kernel itself is causal.

        Attention is causal and padding comes last, so no real token sees padding: a mask for it
        would only cost memory and prevent the fast causal kernel.
        """
        text = self.model.language_model
        # Passed by position, because a name differs between releases: no padding mask, no cache,
        # plain positions.
        given = (text.config, embedded, None, None, None)
        masks: dict[str, Any] = {"full_attention": create_causal_mask(*given)}
        if text.has_sliding_layers:
            masks["sliding_attention"] = create_sliding_window_causal_mask(*given)
        return masks

    def _read(
        self,
        embedded: Float[Tensor, "batch token dim"],
        positions: Int64[Tensor, "3 batch token"],
        masks: Mapping[str, Tensor | None],
        weights: Float[Tensor, "batch place token"],
        real: Bool[Tensor, "batch token"] | None,
    ) -> Float[Tensor, "batch slot dim"]:
        """Run the layers and pool each output at once, so that none is kept in memory."""
        text = self.model.language_model
        rotary = text.rotary_emb(embedded, positions)
        read: dict[tuple[int, bool], Tensor] = {}
        hidden = embedded
        for number, layer in enumerate(text.layers):
            mask = masks[text.config.layer_types[number]]
            hidden = layer(hidden, attention_mask=mask, position_embeddings=rotary, use_cache=False)
            for key in self._reads:
                if key[0] == number:
                    tokens = text.norm(hidden) if key[1] else hidden
                    # Sums over thousands of tokens stay in float32, whatever autocast the caller
                    # uses.
                    with torch.autocast(tokens.device.type, enabled=False):
                        read[key] = pool(tokens, weights, real)
        return torch.cat([read[key] for key in self._reads], dim=1)


def patchify(
    images: UInt8[Tensor, "image height width 3"], settings: PixelSettings
) -> Float[Tensor, "patch value"]:
    """Normalised patches of all images (stretched, uint8), in float32 on the images' device.

    The layout is that of transformers' Qwen2-VL image processor.

    Patches are in the tower's order: blocks of merge size x merge size, row-major; the values of a
    patch are (channel, time, y, x), with the still image repeated over time.
    """
    rows, columns = settings.grid
    merge, patch = settings.merge_size, settings.patch_size
    blocks = images.reshape(
        -1, rows // merge, merge, patch, columns // merge, merge, patch, images.shape[-1]
    )
    # image, block row, block column, row in block, column in block, channel, y, x
    patches = blocks.permute(0, 1, 4, 2, 5, 7, 3, 6).to(torch.float32)
    scale, offset = _normalisation(settings, images.device)
    patches = torch.addcmul(offset, patches, scale)
    frames = patches.unsqueeze(6).expand(*[-1] * 6, settings.temporal_patch_size, -1, -1)
    return frames.reshape(len(images) * rows * columns, -1)


@lru_cache(maxsize=8)
def _normalisation(settings: PixelSettings, device: torch.device) -> tuple[Tensor, Tensor]:
    """Scale and offset of each channel (channel, 1, 1), so that one pass rescales and normalises.

    Cached, because sending them waits for the device.
    """
    mean, std = (
        torch.tensor(values, dtype=torch.float64).reshape(-1, 1, 1)
        for values in (settings.image_mean, settings.image_std)
    )
    scale, offset = settings.rescale_factor / std, -mean / std
    return scale.float().to(device), offset.float().to(device)
