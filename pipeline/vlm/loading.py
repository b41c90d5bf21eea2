"""A checkpoint folder and an optional adapter -> the inner model, every weight accounted for."""

import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import PIL
import torch
import transformers
from safetensors import SafetensorError
from transformers import Qwen2_5_VLForConditionalGeneration
from transformers.utils import is_flash_attn_2_available
from transformers.utils import logging as transformers_logging

from pipeline.base.config import VLMParams
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import adapter_files, resolve_checkpoint, weight_files
from pipeline.vlm.vision import tower_attention

_UNUSED = {"lm_head.weight"}
"""Weights that a feature never meets: a checkpoint may lack them."""


def load_model(vlm: VLMParams, layers: int, device: torch.device) -> Any:
    """The inner `Qwen2_5_VLModel` with its first `layers` decoder layers, frozen, on `device`.

    Raises `VLMError` where a weight is missing or left over, a file is damaged, or the adapter
    does not fit: a model with a random weight is never returned.
    """
    # The language-model head goes with the wrapper: it would cost as much as a small model.
    model = cut(load_whole(vlm, device), layers).model
    return model.eval().requires_grad_(False).to(device)


def load_whole(vlm: VLMParams, device: torch.device, dtype: str | None = None) -> Any:
    """The whole `Qwen2_5_VLForConditionalGeneration`, its adapter merged, on the CPU.

    `dtype` replaces that of `vlm`: "auto" is what the files hold. `device` is where the model is
    meant to run. Raises as `load_model`.
    """
    whole = load_checkpoint(vlm, device, dtype)
    return whole if vlm.adapter is None else adapted(whole, vlm).merge_and_unload(safe_merge=True)


def cut(whole: Any, layers: int) -> Any:
    """The same model with its first `layers` decoder layers only."""
    text = whole.model.language_model
    text.layers = text.layers[:layers]
    return whole


def environment(model: Any) -> dict[str, str]:
    """What may move a feature within its dtype's noise: backends, versions, device.

    Pillow is what stretches and augments frames.
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


@contextmanager
def quiet_transformers() -> Generator[None]:
    """Keep transformers' reports off stderr, and its progress bars unless that is a terminal.

    What they warn of is checked and raised as `VLMError`.
    """
    verbosity = transformers_logging.get_verbosity()
    bar = transformers_logging.is_progress_bar_enabled()
    transformers_logging.set_verbosity_error()
    if not sys.stderr.isatty():
        transformers_logging.disable_progress_bar()
    try:
        yield
    finally:
        transformers_logging.set_verbosity(verbosity)
        if bar:
            transformers_logging.enable_progress_bar()


def attention_backend(vlm: VLMParams, device: torch.device) -> str:
    """What `vlm.attention` means on this device."""
    if vlm.attention != "auto":
        return vlm.attention
    half = vlm.dtype != "float32"
    flash = device.type == "cuda" and half and is_flash_attn_2_available()
    return "flash_attention_2" if flash else "sdpa"


def load_checkpoint(vlm: VLMParams, device: torch.device, dtype: str | None = None) -> Any:
    """As `load_whole`, without the adapter."""
    folder = resolve_checkpoint(vlm.checkpoint, vlm.revision)
    weight_files(folder)
    attention = attention_backend(vlm, device)
    if attention == "flash_attention_2" and (device.type != "cuda" or vlm.dtype == "float32"):
        raise VLMError(
            "vlm.attention flash_attention_2 needs CUDA and a half-precision vlm.dtype, found "
            f"{device.type} and {vlm.dtype}. Set vlm.attention to auto."
        )
    try:
        with quiet_transformers():
            loaded: Any = Qwen2_5_VLForConditionalGeneration.from_pretrained(
                folder,
                dtype=dtype or vlm.dtype,
                attn_implementation=attention,
                local_files_only=True,
                trust_remote_code=False,
                output_loading_info=True,
            )
    except (OSError, ValueError, RuntimeError, ImportError, TypeError, SafetensorError) as error:
        raise VLMError(
            f"{folder}: cannot be loaded as Qwen2.5-VL: {error}. Copy or download it again, or "
            "set vlm.checkpoint to a complete Qwen2.5-VL checkpoint."
        ) from error
    model, report = loaded
    _refuse_strange(
        folder, set(report["missing_keys"]) - _UNUSED, set(report["unexpected_keys"]), "checkpoint"
    )
    return model


def adapted(whole: Any, vlm: VLMParams, dropout: float | None = None) -> Any:
    """The model with `vlm.adapter` on it, not merged: a `PeftModel`.

    With a `dropout` the adapter learns on, under that dropout. Raises `VLMError` where it does not
    fit the checkpoint, or cannot be merged.
    """
    from peft import PeftConfig, PeftModel

    assert vlm.adapter is not None, "no adapter to load"
    folder = resolve_checkpoint(vlm.adapter, setting="vlm.adapter")
    adapter_files(folder)
    try:
        with warnings.catch_warnings():
            # peft only warns of missing weights; the report of a second load is checked instead.
            warnings.simplefilter("ignore")
            config: Any = PeftConfig.from_pretrained(str(folder))
            if dropout is not None:
                config.lora_dropout = dropout
            learns = dropout is not None
            adapting: Any = PeftModel.from_pretrained(
                whole, str(folder), config=config, is_trainable=learns
            )
            report = adapting.load_adapter(str(folder), adapter_name="default", is_trainable=learns)
    except (OSError, ValueError, RuntimeError, KeyError, TypeError, SafetensorError) as error:
        raise VLMError(
            f"{folder}: this adapter does not fit the checkpoint {vlm.checkpoint}: {error}. Set "
            "vlm.adapter to one that was trained on this checkpoint, or to null."
        ) from error
    _refuse_strange(folder, set(report.missing_keys), set(report.unexpected_keys), "adapter")
    if not hasattr(adapting, "merge_and_unload"):
        raise VLMError(f"{folder}: a {config.peft_type} adapter cannot be merged; use LoRA")
    return adapting


def _refuse_strange(folder: Path, missing: set[str], unexpected: set[str], what: str) -> None:
    if missing or unexpected:
        lacks, has = (", ".join(sorted(keys)[:4]) or "none" for keys in (missing, unexpected))
        raise VLMError(
            f"{folder}: the {what}'s weights are not those of the model that it describes: "
            f"missing {lacks} ({len(missing)} in all), left over {has} ({len(unexpected)} in all). "
            f"Copy or download the {what} again."
        )
