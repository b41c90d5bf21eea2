"""Prepared rows -> tensors on the model's device, without waiting for it."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy.typing import NDArray
from torch import Tensor

from pipeline.vlm.pooling import batch_weights
from pipeline.vlm.preparation import PreparedRow, TokenLayout
from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.slots import Slot
from pipeline.vlm.vision import TowerPlan, VisionTower, sent

_KEPT = 8
"""Most arrangements that are kept."""

_STEP = 64
"""Static lengths are multiples of this."""

_SAMPLE = 1024
"""Values of an image that are compared before complete images are."""


@dataclass(frozen=True)
class Arrangement:
    """The tensors that depend only on the rows' layouts, on the model's device."""

    length: int
    real: Bool[Tensor, "batch token"] | None
    """Which tokens are not padding; None where there is no padding."""
    positions: Int64[Tensor, "3 batch token"]
    image_tokens: Int64[Tensor, " image_token"]
    """Indices of the image tokens in the flattened (batch x token)."""
    weights: Float[Tensor, "batch place token"]
    valid: Bool[Tensor, "batch place"]
    """Which places have at least one token; on the CPU."""


@dataclass(frozen=True)
class TokenBatch:
    """Rows side by side, padded on the right, on the model's device."""

    arrangement: Arrangement
    token_ids: Int64[Tensor, "batch token"]
    pixels: UInt8[Tensor, "image height width 3"]
    """Each distinct image once."""
    plan: TowerPlan | None
    """The tower's plan for these images; None where there is no image."""
    shown: Int64[Tensor, " image_token"]
    """For each image token of the batch, the index of the tower's token."""


class Collator:
    """Makes batches; whatever depends only on layouts and image counts is computed once."""

    def __init__(
        self,
        model: Any,
        settings: PixelSettings,
        places: tuple[Slot, ...],
        tower: VisionTower,
        static: bool = False,
    ) -> None:
        """With `static`, batches of equally many rows of one layout have one shape: repeated images
        are not merged, and lengths are rounded up."""
        self._model, self._tower = model, tower
        self._settings, self._places, self._static = settings, places, static
        self._positions: dict[TokenLayout, Int64[Tensor, "3 token"]] = {}
        self._arrangements: dict[tuple[TokenLayout, ...], Arrangement] = {}

    def collate(self, rows: Sequence[PreparedRow]) -> TokenBatch:
        """The batch of these rows."""
        arrangement = self._arrangement(tuple(row.layout for row in rows))
        token_ids = self._pinned((len(rows), arrangement.length), torch.int64)
        token_ids.zero_()
        for ids, row in zip(token_ids.numpy(), rows, strict=True):
            ids[: len(row.token_ids)] = row.token_ids
        images = [image for row in rows for image in row.pixels]
        distinct, which = (images, list(range(len(images)))) if self._static else unique(images)
        pixels = self._pinned((len(distinct), *self._settings.image_size, 3), torch.uint8)
        for place, image in zip(pixels.numpy(), distinct, strict=True):
            place[:] = image
        device = self._model.device
        plan = self._tower.plan(len(distinct), device) if distinct else None
        shown = np.empty(0, np.int64)
        if plan is not None:
            tokens = math.prod(self._settings.merged_grid)
            shown = plan.place.reshape(-1, tokens)[which].reshape(-1)
        sent_shown = sent(torch.from_numpy(shown), device)
        return TokenBatch(
            arrangement, sent(token_ids, device), sent(pixels, device), plan, sent_shown
        )

    def _arrangement(self, layouts: tuple[TokenLayout, ...]) -> Arrangement:
        if layouts not in self._arrangements:
            if len(self._arrangements) == _KEPT:
                del self._arrangements[next(iter(self._arrangements))]
            self._arrangements[layouts] = self._arranged(layouts)
        return self._arrangements[layouts]

    def _arranged(self, layouts: tuple[TokenLayout, ...]) -> Arrangement:
        length = max(layout.length for layout in layouts)
        if self._static:
            length = -(-length // _STEP) * _STEP
        real = torch.zeros(len(layouts), length, dtype=torch.bool)
        positions = torch.zeros(3, len(layouts), length, dtype=torch.int64)
        for index, layout in enumerate(layouts):
            real[index, : layout.length] = True
            positions[:, index, : layout.length] = self._rope_positions(layout)
        image_tokens = np.concatenate(
            [index * length + layout.image_tokens() for index, layout in enumerate(layouts)]
        )
        weights = batch_weights(self._places, layouts, length)
        device = self._model.device
        return Arrangement(
            length,
            None if bool(real.all()) else sent(real, device),
            sent(positions, device),
            sent(torch.from_numpy(image_tokens), device),
            sent(weights, device),
            (weights != 0).any(dim=-1),
        )

    def _rope_positions(self, layout: TokenLayout) -> Int64[Tensor, "3 token"]:
        """Time, height and width position of each token; computed once per layout, on the CPU."""
        if layout not in self._positions:
            kinds = torch.zeros(1, layout.length, dtype=torch.int64)
            kinds[0, torch.from_numpy(layout.image_tokens())] = 1
            grids = [(1, *self._settings.grid)] * len(layout.image_starts)
            positions, _ = self._model.get_rope_index(
                torch.zeros_like(kinds),
                mm_token_type_ids=kinds,
                image_grid_thw=torch.tensor(grids) if grids else None,
            )
            self._positions[layout] = positions[:, 0]
        return self._positions[layout]

    def _pinned(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Memory from which the device can copy while the host goes on."""
        return torch.empty(shape, dtype=dtype, pin_memory=self._model.device.type == "cuda")


def unique(images: Sequence[NDArray[np.uint8]]) -> tuple[list[NDArray[np.uint8]], list[int]]:
    """The distinct images, in order, and the index of each image among them.

    Equal images have all values equal; a sample of values only saves most comparisons.
    """
    distinct: list[NDArray[np.uint8]] = []
    alike: dict[bytes, list[int]] = defaultdict(list)
    which: list[int] = []
    for image in images:
        flat = image.reshape(-1)
        sampled = alike[flat[:: max(1, flat.size // _SAMPLE)].tobytes()]
        known = next((k for k in sampled if np.array_equal(distinct[k], image)), None)
        if known is None:
            known = len(distinct)
            distinct.append(image)
            sampled.append(known)
        which.append(known)
    return distinct, which
