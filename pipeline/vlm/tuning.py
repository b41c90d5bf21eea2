"""Which weights of the model learn, and how the learned weights are saved."""

import re
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from pipeline.base.config import TuningParams, VLMParams
from pipeline.base.errors import VLMError
from pipeline.base.files import disk_full_named, sync, write_tensors
from pipeline.vlm.checkpoint_folder import quiet_transformers, resolve_checkpoint
from pipeline.vlm.loading import adapted, cut, load_checkpoint, load_whole
from pipeline.vlm.slots import Slot

TOWERS = {"language": "model.language_model.", "vision": "model.visual."}
"""Prefix of each tower's names in a `Qwen2_5_VLForConditionalGeneration`."""


_COMPANIONS = ("*config.json", "chat_template.*", "*token*.json", "vocab.json", "merges.txt")
"""The files of a checkpoint folder besides its weights."""


def load_adapting(
    vlm: VLMParams, tuning: TuningParams, layers: int, device: torch.device
) -> tuple[Any, dict[str, Tensor]]:
    """A `PeftModel` of the first `layers` layers whose low-rank adapters learn, on the CPU.

    There is one on every linear layer of the chosen towers; with `vlm.adapter`, training continues
    from that adapter. Also returns that adapter's weights on later layers, which a saved adapter
    keeps. Raises `VLMError` where the adapter has another rank, scale or towers than `tuning`.
    """
    whole = load_checkpoint(vlm, device)
    # Features do not use the head.
    whole.lm_head = nn.Identity()
    if vlm.adapter is None:
        model, beyond = _fresh_adapter(whole, vlm, tuning, layers), {}
    else:
        model = adapted(whole, vlm, tuning.lora_dropout)
        _check_goes_on(model, vlm, tuning)
        beyond = _beyond(model, layers)
    cut(whole, layers)
    model.requires_grad_(False)
    learning = tuple(f"base_model.model.{TOWERS[tower]}" for tower in tuning.towers)
    for name, parameter in model.named_parameters():
        parameter.requires_grad = "lora_" in name and name.startswith(learning)
    model.peft_config["default"].base_model_name_or_path = vlm.checkpoint
    model.peft_config["default"].revision = vlm.revision
    return model, beyond


def load_learning(
    vlm: VLMParams, tuning: TuningParams, slots: tuple[Slot, ...], layers: int, device: torch.device
) -> Any:
    """The inner model of the first `layers` layers, in which every weight of the towers learns.

    Those weights are always float32, because `vlm.dtype` may be too coarse for small steps.
    """
    whole = cut(load_whole(vlm, device), layers)
    whole.requires_grad_(False)
    for tower in tuning.towers:
        whole.get_submodule(TOWERS[tower].rstrip(".")).float().requires_grad_(True)
    if not any(slot.norm for slot in slots):
        # Nothing reads the output of the final norm.
        whole.model.language_model.norm.requires_grad_(False)
    return whole.model


def save_adapter(folder: Path, model: Any, beyond: Mapping[str, Tensor]) -> None:
    """Write the adapter of a `PeftModel` in peft's format, with its weights on later layers.

    Raises `DiskFull`.
    """
    weights = folder / "adapter_model.safetensors"
    with disk_full_named(folder):
        # Otherwise peft asks the hub whether embeddings were resized, which never happens here.
        model.save_pretrained(str(folder), save_embedding_layers=False)
        # An empty template of a model card.
        (folder / "README.md").unlink(missing_ok=True)
        if beyond:
            write_tensors(weights, load_file(weights) | dict(beyond))
        _finish(folder)


def save_checkpoint(folder: Path, vlm: VLMParams, tuned: Mapping[str, Tensor]) -> None:
    """Write the checkpoint of `vlm` with these weights in its inner model.

    All other weights (with `vlm.adapter` merged) and files are those of the base; weights keep the
    dtype of its files. Raises `DiskFull`.
    """
    plain = vlm.model_copy(update={"attention": "sdpa"})
    whole = load_whole(plain, torch.device("cpu"), dtype="auto")
    report = whole.model.load_state_dict(dict(tuned), strict=False)
    assert not report.unexpected_keys, report.unexpected_keys
    base = resolve_checkpoint(vlm.checkpoint, vlm.revision)
    with disk_full_named(folder), quiet_transformers():
        whole.save_pretrained(folder)
        for path in (path for pattern in _COMPANIONS for path in base.glob(pattern)):
            shutil.copyfile(path, folder / path.name)
        _finish(folder)


def _fresh_adapter(whole: Any, vlm: VLMParams, tuning: TuningParams, layers: int) -> Any:
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
    towers = tuple(TOWERS[tower] for tower in tuning.towers)
    patterns: dict[str, None] = {}
    for name, module in whole.named_modules():
        if isinstance(module, nn.Linear) and name.startswith(towers):
            pattern = re.sub(r"(blocks\\\.)\d+", r"\1\\d+", re.escape(name))
            patterns[re.sub(r"(layers\\\.)\d+", rf"\1({kept})", pattern)] = None
    return "|".join(patterns)


def _check_goes_on(model: Any, vlm: VLMParams, tuning: TuningParams) -> None:
    config = model.peft_config["default"]
    # Other kinds of adapters lack them.
    r, alpha = (getattr(config, name, None) for name in ("r", "lora_alpha"))
    actual = f"lora_r {r}, lora_alpha {alpha}"
    asked = f"lora_r {tuning.lora_r}, lora_alpha {tuning.lora_alpha}"
    if actual != asked:
        raise VLMError(
            f"{vlm.adapter}: tuning goes on from this adapter of {actual}, but {asked} is asked "
            "for. Set finetune.tuning to the adapter's values, or vlm.adapter to null."
        )
    names = [name for name, _ in model.named_parameters() if "lora_" in name]
    for tower in tuning.towers:
        if not any(name.startswith(f"base_model.model.{TOWERS[tower]}") for name in names):
            raise VLMError(
                f"{vlm.adapter}: tuning goes on from this adapter, which has nothing in the "
                f"{tower} tower. Leave it out of finetune.tuning.towers, or set vlm.adapter to "
                "null."
            )


def _beyond(model: Any, layers: int) -> dict[str, Tensor]:
    """The adapter's weights on decoder layers that do not run, by name in its file."""
    place = re.compile(r"\.language_model\.layers\.(\d+)\..*\.lora_")
    weights = ((name, place.search(name), tensor) for name, tensor in model.state_dict().items())
    return {
        name.replace(".default.", "."): tensor
        for name, match, tensor in weights
        if match and int(match[1]) >= layers
    }


def _finish(folder: Path) -> None:
    """Give the files the folder's mode (safetensors writes only for the owner) and sync them."""
    for file in folder.iterdir():
        file.chmod(folder.stat().st_mode & 0o666)
        sync(file)
    sync(folder)
