"""The Qwen2.5-VL that learns: it computes features with gradients and saves its weights."""

import re
import shutil
import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.base.config import PCA, TuningParams, VLMParams
from pipeline.base.digests import file_digest
from pipeline.base.errors import CheckpointMismatch, VLMError
from pipeline.base.files import disk_full_named, sync
from pipeline.base.hardware import resolve_device
from pipeline.base.projection import Basis
from pipeline.base.text import capped
from pipeline.vlm.checkpoint_folder import resolve_checkpoint
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec, live_differences
from pipeline.vlm.loading import cut, load_checkpoint, load_model, load_whole
from pipeline.vlm.preparation import PreparedRow
from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.qwen import Extractor, layers_needed
from pipeline.vlm.slots import Slot

_TOWERS = {"language": "model.language_model.", "vision": "model.visual."}
"""Prefix of each tower's names in a `Qwen2_5_VLForConditionalGeneration`."""

_COMPANIONS = ("*config.json", "chat_template.*", "*token*.json", "vocab.json", "merges.txt")
"""The files of a checkpoint folder besides its weights."""


def live_spec(vlm: VLMParams, views: Sequence[str], basis: Basis | None = None) -> FeatureSpec:
    """The spec of the features of a live model of `vlm`; reads every file for its digest.

    A `basis` projects them. They are not stored: compare the spec with that of stored ones by
    `live_differences`.
    """
    dtype = "float32" if basis is None else PCA(pca=basis.maps.shape[2], then="float32")
    return feature_spec(vlm, dtype, views, file_digest, basis=basis)


def refuse_other_features(vlm: VLMParams, trained: Mapping[str, Any], live: FeatureSpec) -> None:
    """Raise `CheckpointMismatch` where features of the spec `trained` are not those of `live`.

    The error lists the entries of `live_differences`. No weight is loaded.
    """
    if lines := live_differences(trained, live.document):
        raise CheckpointMismatch(
            f"{vlm.checkpoint}: the policy was trained on other features than this model "
            "gives (trained -> live):\n  " + "\n  ".join(capped(lines, "entries")) + "\nLoad the "
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

    @classmethod
    def load(
        cls, vlm: VLMParams, spec: FeatureSpec, tuning: TuningParams, device: str = "auto"
    ) -> "LiveVLM":
        """The checkpoint of `vlm`, cut after the last layer needed; `tuning` decides what learns.

        `vlm.adapter` is merged first. Raises `VLMError` like `FrozenVLM.load`, for `lora` on top of
        an adapter, and for float16, whose gradients underflow.
        """
        target = resolve_device(device)
        layers = layers_needed(spec.slots)
        if tuning.method != "none" and vlm.dtype == "float16":
            raise VLMError(
                "vlm.dtype float16 is too narrow for gradients. Set it to bfloat16 or float32 to "
                "tune the model."
            )
        model: Any
        if tuning.method == "none":
            model = inner = load_model(vlm, layers, target)
        elif tuning.method == "full":
            model = inner = _load_learning(vlm, tuning, spec.slots, layers, target)
        else:
            model = _load_adapting(vlm, tuning, layers, target)
            inner = model.base_model.model.model
        if tuning.method != "none" and tuning.gradient_checkpointing:
            inner.activation_checkpointing_enable({"use_reentrant": False})
            # Image tokens are written into the embeddings in place, which a leaf that requires
            # gradients would refuse; non-reentrant checkpoints need no such input.
            inner.disable_input_require_grads()
        model = model.to(target)  # before the extractor, which puts the basis beside it
        extractor = Extractor(inner, PixelSettings.of(vlm), spec.slots, basis=spec.basis)
        return cls(model, extractor, spec, vlm, tuning)

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
            _save_adapter(folder, self.model)
        else:
            _save_checkpoint(folder, self.vlm, self.model.state_dict())

    def _precision(self) -> AbstractContextManager[Any]:
        """Autocast for a full tuning in half precision, whose learning weights are float32."""
        device = self._extractor.model.device.type
        half = self.tuning.method == "full" and self.vlm.dtype != "float32"
        return torch.autocast(device, getattr(torch, self.vlm.dtype) if half else None, half)


def _load_adapting(vlm: VLMParams, tuning: TuningParams, layers: int, device: torch.device) -> Any:
    """A `PeftModel` of the first `layers` layers whose low-rank adapters learn, on the CPU.

    There is one on every linear layer of the chosen towers.
    """
    if vlm.adapter is not None:
        raise VLMError(
            f"vlm.adapter {vlm.adapter}: lora begins from a checkpoint without an adapter. Set "
            "vlm.adapter to null, or finetune.tuning.method to full, which merges it first."
        )
    whole = load_checkpoint(vlm, device)
    # Features do not use the head.
    whole.lm_head = nn.Identity()
    model = _fresh_adapter(whole, tuning, layers)
    cut(whole, layers)
    model.requires_grad_(False)
    for name, parameter in model.named_parameters():
        parameter.requires_grad = "lora_" in name
    model.peft_config["default"].base_model_name_or_path = vlm.checkpoint
    model.peft_config["default"].revision = vlm.revision
    return model


def _load_learning(
    vlm: VLMParams, tuning: TuningParams, slots: tuple[Slot, ...], layers: int, device: torch.device
) -> Any:
    """The inner model of the first `layers` layers, in which every weight of the towers learns.

    Those weights are always float32, because `vlm.dtype` may be too coarse for small steps.
    """
    whole = cut(load_whole(vlm, device), layers)
    whole.requires_grad_(False)
    for tower in tuning.towers:
        whole.get_submodule(_TOWERS[tower].rstrip(".")).float().requires_grad_(True)
    if not any(slot.norm for slot in slots):
        # Nothing reads the output of the final norm.
        whole.model.language_model.norm.requires_grad_(False)
    return whole.model


def _save_adapter(folder: Path, model: Any) -> None:
    """Write the adapter of a `PeftModel` in peft's format. Raises `DiskFull`."""
    with disk_full_named(folder):
        # Otherwise peft asks the hub whether embeddings were resized, which never happens here.
        model.save_pretrained(str(folder), save_embedding_layers=False)
        # An empty template of a model card.
        (folder / "README.md").unlink(missing_ok=True)
        _finish(folder)


def _save_checkpoint(folder: Path, vlm: VLMParams, tuned: Mapping[str, Tensor]) -> None:
    """Write the checkpoint of `vlm` with these weights in its inner model.

    All other weights (with `vlm.adapter` merged) and files are those of the base; weights keep the
    dtype of its files. Raises `DiskFull`.
    """
    plain = vlm.model_copy(update={"attention": "sdpa"})
    whole = load_whole(plain, torch.device("cpu"), dtype="auto")
    report = whole.model.load_state_dict(dict(tuned), strict=False)
    assert not report.unexpected_keys, report.unexpected_keys
    base = resolve_checkpoint(vlm.checkpoint, vlm.revision)
    with disk_full_named(folder):
        whole.save_pretrained(folder)
        for path in (path for pattern in _COMPANIONS for path in base.glob(pattern)):
            shutil.copyfile(path, folder / path.name)
        _finish(folder)


def _fresh_adapter(whole: Any, tuning: TuningParams, layers: int) -> Any:
    from peft import LoraConfig, get_peft_model

    config = LoraConfig(
        r=tuning.lora_r,
        lora_alpha=tuning.lora_alpha,
        lora_dropout=tuning.lora_dropout,
        target_modules=_targets(whole, tuning, layers),
    )
    with warnings.catch_warnings():
        # peft 0.21 reads an attribute that is deprecated in transformers 5.23.
        warnings.filterwarnings("ignore", "`is_gradient_checkpointing`", FutureWarning)
        return get_peft_model(whole, config)


def _targets(whole: Any, tuning: TuningParams, layers: int) -> str:
    """A regular expression that matches the linear layers that run, and no other module.

    It is written into the adapter's config, where a set of names would be in random order.
    """
    kept = "|".join(map(str, range(layers)))
    towers = tuple(_TOWERS[tower] for tower in tuning.towers)
    patterns: dict[str, None] = {}
    for name, module in whole.named_modules():
        if isinstance(module, nn.Linear) and name.startswith(towers):
            pattern = re.sub(r"(blocks\\\.)\d+", r"\1\\d+", re.escape(name))
            patterns[re.sub(r"(layers\\\.)\d+", rf"\1({kept})", pattern)] = None
    return "|".join(patterns)


def _finish(folder: Path) -> None:
    """Give the files the folder's mode (safetensors writes only for the owner) and sync them."""
    for file in folder.iterdir():
        file.chmod(folder.stat().st_mode & 0o666)
        sync(file)
    sync(folder)
