"""A checkpoint folder and an optional adapter -> the inner model; checks every weight."""

import warnings
from pathlib import Path
from typing import Any

import PIL
import torch
import transformers
from transformers import Qwen2_5_VLForConditionalGeneration
from transformers.utils import is_flash_attn_2_available

from pipeline.base.config import VLMParams
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import (
    ADAPTERS,
    VLMS,
    adapter_files,
    read_config,
    resolve_checkpoint,
    weight_files,
)
from pipeline.vlm.vision import tower_attention

_UNUSED = {"lm_head.weight"}
"""Weights that features do not use, so a checkpoint may lack them."""
_ADAPTER_FILES = "adapter_model.safetensors and adapter_config.json"


def load_model(vlm: VLMParams, layers: int, device: torch.device) -> Any:
    """The inner `Qwen2_5_VLModel` with its first `layers` decoder layers, frozen, on `device`.

    Raises `VLMError` where a weight is missing or unexpected, a file is damaged, or the adapter
    does not fit. A model with a random weight is never returned.
    """
    # The wrapper is dropped with its language-model head, which is as large as a small model.
    model = cut(load_whole(vlm, device), layers).model
    return model.eval().requires_grad_(False).to(device)


def load_whole(vlm: VLMParams, device: torch.device, dtype: str | None = None) -> Any:
    """The whole `Qwen2_5_VLForConditionalGeneration`, its adapter merged, on the CPU.

    `dtype` replaces that of `vlm`; "auto" is the dtype of the files. `device` is where the model
    will run. Raises like `load_model`.
    """
    whole = load_checkpoint(vlm, device, dtype)
    if vlm.adapter is None:
        return whole
    adapting = _adapted(whole, vlm)
    with ADAPTERS.foreign(Path(vlm.adapter), "this adapter cannot be merged"):
        return adapting.merge_and_unload(safe_merge=True)


def cut(whole: Any, layers: int) -> Any:
    """The same model with only its first `layers` decoder layers."""
    text = whole.model.language_model
    text.layers = text.layers[:layers]
    return whole


def environment(model: Any) -> dict[str, str]:
    """Backends, versions and device, which may change a feature within its dtype's noise.

    Pillow is listed because it stretches and augments frames.
    """
    device, cuda = model.device, model.device.type == "cuda"
    return {
        "attention": str(model.language_model.config._attn_implementation),
        "vision_attention": tower_attention(model.visual),
        "torch": torch.__version__,
        "transformers": transformers.__version__,
        "pillow": PIL.__version__,
        "device": torch.cuda.get_device_name(device) if cuda else device.type,
    }


def attention_backend(vlm: VLMParams, device: torch.device) -> str:
    """The attention backend of `vlm` on this device."""
    if vlm.attention != "auto":
        return vlm.attention
    half = vlm.dtype != "float32"
    flash = device.type == "cuda" and half and is_flash_attn_2_available()
    return "flash_attention_2" if flash else "sdpa"


def load_checkpoint(vlm: VLMParams, device: torch.device, dtype: str | None = None) -> Any:
    """Like `load_whole`, without the adapter."""
    folder = resolve_checkpoint(vlm.checkpoint, vlm.revision)
    files = weight_files(folder)
    attention = attention_backend(vlm, device)
    if attention == "flash_attention_2" and (device.type != "cuda" or vlm.dtype == "float32"):
        raise VLMError(
            "vlm.attention flash_attention_2 needs CUDA and a half-precision vlm.dtype, found "
            f"{device.type} and {vlm.dtype}. Set vlm.attention to auto."
        )
    config = read_config(folder)
    with VLMS.foreign(folder, "cannot be loaded as Qwen2.5-VL"):
        loaded: Any = Qwen2_5_VLForConditionalGeneration.from_pretrained(
            folder,
            config=config,
            dtype=dtype or vlm.dtype,
            attn_implementation=attention,
            local_files_only=True,
            trust_remote_code=False,
            ignore_mismatched_sizes=True,  # refused below, by name
            output_loading_info=True,
        )
    model, report = loaded
    missing, unexpected = set(report["missing_keys"]) - _UNUSED, set(report["unexpected_keys"])
    _refuse_strange(folder, missing, unexpected, f"{files[-1].name} and config.json")
    for name, stored, wanted in report["mismatched_keys"]:
        why = f"expected {name} of {list(wanted)} by config.json, found {list(stored)}"
        raise VLMS.refusal(folder, why)
    return model


def _adapted(whole: Any, vlm: VLMParams) -> Any:
    """The model with `vlm.adapter` on it, not merged: a `PeftModel`.

    Raises `VLMError` where the adapter does not fit the checkpoint.
    """
    from peft import PeftModel

    assert vlm.adapter is not None, "no adapter to load"
    folder = resolve_checkpoint(vlm.adapter, setting="vlm.adapter")
    adapter_files(folder)
    what = f"{_ADAPTER_FILES} hold what does not fit the checkpoint {vlm.checkpoint}"
    with warnings.catch_warnings(), ADAPTERS.foreign(folder, what):
        # peft only warns about missing weights, so the report of a second load is checked.
        warnings.simplefilter("ignore")
        adapting: Any = PeftModel.from_pretrained(whole, str(folder))
        report = adapting.load_adapter(str(folder), adapter_name="default")
    unexpected = set(report.unexpected_keys)
    _refuse_strange(folder, set(report.missing_keys), unexpected, _ADAPTER_FILES)
    return adapting


def _refuse_strange(folder: Path, missing: set[str], unexpected: set[str], files: str) -> None:
    if missing or unexpected:
        lacks, has = (", ".join(sorted(keys)[:4]) or "none" for keys in (missing, unexpected))
        raise VLMError(
            f"{folder}: {files} do not fit each other: "
            f"missing {lacks} ({len(missing)} in all), left over {has} ({len(unexpected)} in all). "
            "Copy or download them again."
        )
