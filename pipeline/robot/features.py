"""Frames -> features, by the very model that the policy was trained on."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.typing import NDArray
from torch import Tensor

from pipeline.base.config import TuningParams, VLMParams
from pipeline.base.golden import row_key
from pipeline.vlm.live import LiveVLM, live_spec, refuse_other_features
from pipeline.vlm.preparation import Preparer

_ROWS = 16
"""Frame sets a pass of the model."""


class LiveFeatures:
    """The frozen model of `vlm`, of which a policy's features are asked live."""

    def __init__(self, vlm: VLMParams, trained: Mapping[str, Any], device: str) -> None:
        """Load it; `trained` is the feature spec of the policy's checkpoint.

        Raises `CheckpointMismatch` where the policy was trained on other features than this model
        gives, before a weight is loaded, and `VLMError` as `LiveVLM.load`.
        """
        self.spec = live_spec(vlm, trained["views"])
        """What it gives, stored nowhere."""
        refuse_other_features(vlm, trained, self.spec)
        self._model = LiveVLM.load(vlm, self.spec, TuningParams(method="none"), device).eval()
        self._preparer = Preparer(vlm, self.spec)
        self._trained = trained

    def prompt(self, instruction: str, views: Sequence[str]) -> str:
        """What the model is given to read with frames of these views."""
        return self._preparer.render(instruction, views)

    def key(self, frames: Mapping[str, NDArray[np.uint8]], instruction: str) -> bytes:
        """The key (16 bytes) that these frames have in the store that the policy was trained on."""
        prompt = self.prompt(instruction, list(frames))
        return row_key(self._trained["digest"], self._trained["views"], prompt, frames)

    @torch.inference_mode()
    def __call__(
        self, frames: Sequence[Mapping[str, "UInt8[ndarray, 'height width 3']"]], instruction: str
    ) -> tuple[Float[Tensor, "row slot dim"], Bool[Tensor, "row slot"]]:
        """Features of each set of RGB frames by view in float32, and which slots are valid."""
        rows = [self._preparer.prepare(instruction, views) for views in frames]
        batches = [self._model(rows[at : at + _ROWS]) for at in range(0, len(rows), _ROWS)]
        features, valid = zip(*batches, strict=True)
        return torch.cat(features).cpu(), torch.cat(valid).cpu()
