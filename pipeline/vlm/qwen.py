"""The frozen Qwen2.5-VL: load, adapt, encode."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.config import VLMParams
from pipeline.device import resolve_device
from pipeline.errors import NumericsError
from pipeline.vlm.extractor import Extractor, layers_needed
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.loading import environment, load_model, pixel_settings
from pipeline.vlm.pixels import PixelSettings
from pipeline.vlm.preparation import PreparedRow


class FrozenVLM:
    """A loaded Qwen2.5-VL that turns prepared rows into pooled features, and never learns."""

    environment: dict[str, str]
    """Attention backend, library versions and device: recorded, not part of the identity."""

    def __init__(
        self, model: Any, settings: PixelSettings, spec: FeatureSpec, device: torch.device
    ) -> None:
        """Wrap an inner `Qwen2_5_VLModel` that is already on `device`."""
        self._model = model
        self._extractor = Extractor(model, settings, spec.slots)
        self._spec = spec
        self._storage_dtype = getattr(torch, spec.document["storage_dtype"])
        self.environment = environment(model, device)

    @classmethod
    def load(cls, vlm: VLMParams, spec: FeatureSpec, device: str = "auto") -> "FrozenVLM":
        """The checkpoint (and adapter) of `vlm` in its dtype, cut after the last layer needed.

        `device` is a torch device or "auto": CUDA where there is one. Raises `VLMError` where the
        folder is incomplete, a weight is missing or left over, or the adapter does not fit.
        """
        target = resolve_device(device)
        model = load_model(vlm, layers_needed(spec.slots), target)
        return cls(model, pixel_settings(vlm), spec, target)

    @torch.no_grad()
    def encode(
        self, rows: Sequence[PreparedRow]
    ) -> tuple[Float[Tensor, "batch slot dim"], Bool[Tensor, "batch slot"]]:
        """Features of each row in the storage dtype, and which slots are valid, both on the CPU.

        A slot whose view is missing is zero and invalid. A row is the same, within the compute
        dtype's noise, whatever rows stand beside it; rows of equal `shape_key` are fastest.
        Raises `NumericsError` naming row and slot where a feature is NaN or infinite.
        """
        features, valid = self._extractor.extract(rows)
        features = features.to(self._storage_dtype).cpu()
        self._check_finite(features)
        return features, valid

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
