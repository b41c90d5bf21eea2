"""The Qwen2.5-VL that learns: it computes features with gradients and saves its weights."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.base.config import TuningParams, VLMParams
from pipeline.base.digests import file_digest
from pipeline.base.errors import CheckpointMismatch, VLMError
from pipeline.base.machine import resolve_device
from pipeline.vlm.extractor import Extractor, layers_needed
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec, live_differences
from pipeline.vlm.loading import load_model
from pipeline.vlm.preparation import PreparedRow
from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.tuning import load_adapting, load_learning, save_adapter, save_checkpoint


def live_spec(vlm: VLMParams, views: Sequence[str]) -> FeatureSpec:
    """The spec of the features of a live model of `vlm`; reads every file for its digest.

    These features are not stored: compare the spec with that of stored ones by `live_differences`.
    """
    return feature_spec(vlm, "float32", views, file_digest)


_SHOWN = 8
"""Entries of a feature spec that a message names."""


def refuse_other_features(vlm: VLMParams, trained: Mapping[str, Any], live: FeatureSpec) -> None:
    """Raise `CheckpointMismatch` where features of the spec `trained` are not those of `live`.

    The error lists the entries of `live_differences`. No weight is loaded.
    """
    if lines := live_differences(trained, live.document):
        more = [f"… and {len(lines) - _SHOWN} more"] if len(lines) > _SHOWN else []
        raise CheckpointMismatch(
            f"{vlm.checkpoint}: the policy was trained on other features than this model "
            "gives (trained -> live):\n  " + "\n  ".join([*lines[:_SHOWN], *more]) + "\nLoad the "
            "model with the vlm params and views of the policy's store (slots follow from "
            "vlm.layers, norms, pooling and grid), or train on this model's features."
        )


class LiveVLM(nn.Module):
    """A Qwen2.5-VL that computes the features of `spec` from prepared rows, and may learn.

    The learning weights have `requires_grad` and are float32: none, low-rank adapters on the linear
    layers of the chosen towers, or every weight of those towers. The rest computes as in
    `FrozenVLM`, so both give the same features within the noise of `vlm.dtype`. In `train()` mode
    adapters use dropout and activations are checkpointed.

    `copy.deepcopy` with a memo of the frozen parameters shares them.
    """

    spec: FeatureSpec
    vlm: VLMParams
    tuning: TuningParams

    def __init__(
        self,
        model: nn.Module,
        extractor: Extractor,
        spec: FeatureSpec,
        vlm: VLMParams,
        tuning: TuningParams,
    ) -> None:
        """Wrap `model`, which is or holds the extractor's inner model."""
        super().__init__()
        self.model = model
        self.spec, self.vlm, self.tuning = spec, vlm, tuning
        self._extractor = extractor
        self._beyond: dict[str, Tensor] = {}

    @classmethod
    def load(
        cls, vlm: VLMParams, spec: FeatureSpec, tuning: TuningParams, device: str = "auto"
    ) -> "LiveVLM":
        """The checkpoint of `vlm`, cut after the last layer needed; `tuning` decides what learns.

        With `vlm.adapter`, `lora` continues to train that adapter; `none` and `full` merge it
        first. Raises `VLMError` like `FrozenVLM.load`, where the adapter does not match `tuning`,
        and for float16, whose gradients underflow.
        """
        target = resolve_device(device)
        layers = layers_needed(spec.slots)
        if tuning.method != "none" and vlm.dtype == "float16":
            raise VLMError(
                "vlm.dtype float16 is too narrow for gradients. Set it to bfloat16 or float32 to "
                "tune the model."
            )
        model: Any
        beyond: dict[str, Tensor] = {}
        if tuning.method == "none":
            model = inner = load_model(vlm, layers, target)
        elif tuning.method == "full":
            model = inner = load_learning(vlm, tuning, spec.slots, layers, target)
        else:
            model, beyond = load_adapting(vlm, tuning, layers, target)
            inner = model.base_model.model.model
        if tuning.method != "none" and tuning.gradient_checkpointing:
            inner.activation_checkpointing_enable({"use_reentrant": False})
            # Image tokens are written into the embeddings in place, which a leaf that requires
            # gradients would refuse; non-reentrant checkpoints need no such input.
            inner.disable_input_require_grads()
        extractor = Extractor(inner, PixelSettings.of(vlm), spec.slots)
        live = cls(model.to(target), extractor, spec, vlm, tuning)
        live._beyond = beyond
        return live

    def forward(
        self, rows: Sequence[PreparedRow]
    ) -> tuple[Float[Tensor, "row slot dim"], Bool[Tensor, "row slot"]]:
        """Features of each row in float32 and which slots are valid, on the model's device.

        A slot whose view is missing is zero and invalid. A row's features do not depend on the
        other rows, except for the compute dtype's noise. Computes in `vlm.dtype`, whatever autocast
        the caller uses.
        """
        with self._precision():
            features, valid = self._extractor.extract(rows)
        return features, valid.to(features.device)

    def refuse_other_features(self, trained: Mapping[str, Any]) -> None:
        """Raise `CheckpointMismatch` where this model does not compute the features of `trained`.

        See the function `refuse_other_features`.
        """
        refuse_other_features(self.vlm, trained, self.spec)

    def check_shape(self, slots: int, feature_dim: int) -> None:
        """Raise `VLMError` where a policy was built for another number or width of features."""
        if (len(self.spec.slots), self.spec.dim) != (slots, feature_dim):
            raise VLMError(
                f"{self.vlm.checkpoint}: gives {len(self.spec.slots)} feature slots of width "
                f"{self.spec.dim}, but the policy was built for {slots} of width {feature_dim}. "
                f"Build it with feature_dim={self.spec.dim} and the model's views and slots."
            )

    def save(self, folder: Path) -> None:
        """Write the learned weights into `folder`, which is created if needed.

        `lora`: a peft adapter for `vlm.adapter`; `full`: a complete checkpoint for `vlm.checkpoint`
        (then with `vlm.adapter` null), with weights in the dtype of the base's files; `none`:
        nothing. Raises `DiskFull`.
        """
        if self.tuning.method == "none":
            return
        folder.mkdir(parents=True, exist_ok=True)
        if self.tuning.method == "lora":
            save_adapter(folder, self.model, self._beyond)
        else:
            save_checkpoint(folder, self.vlm, self.model.state_dict())

    def _precision(self) -> AbstractContextManager[Any]:
        """Autocast for a full tuning in half precision, whose learning weights are float32."""
        device = self._extractor.model.device.type
        half = self.tuning.method == "full" and self.vlm.dtype != "float32"
        return torch.autocast(device, getattr(torch, self.vlm.dtype) if half else None, half)
