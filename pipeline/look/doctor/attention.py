"""Which attention backends the model could use here, and which it would."""

from importlib import import_module

import torch

from pipeline.base.config import Params
from pipeline.look.doctor.findings import Finding, missing, note, ok
from pipeline.look.doctor.gpu import usable_device
from pipeline.look.doctor.packages import importable
from pipeline.vlm.loading import attention_backend

FLASH = "pip install flash-attn --no-build-isolation"
_KERNELS = {
    "flash": torch.backends.cuda.is_flash_attention_available,
    "memory-efficient": torch.backends.cuda.mem_efficient_sdp_enabled,
    "cudnn": torch.backends.cuda.cudnn_sdp_enabled,
    "math": torch.backends.cuda.math_sdp_enabled,
}


def check_attention(params: Params) -> list[Finding]:
    """torch's own kernels, flash-attention, and what `vlm.attention` comes to."""
    device = usable_device(params.extract.device)
    if device is None:
        return [note("attention", "not known before extract.device can be used, see GPU")]
    asked = params.vlm.attention
    flash = flash_trouble()
    findings = [ok("sdpa", _sdpa(device)), check_flash(flash, device.type, asked)]
    if findings[-1].level != "missing":
        said = f"vlm.attention: {asked} takes {attention_backend(params.vlm, device)} on {device}"
        findings.append(ok("chosen", f"{said} with vlm.dtype {params.vlm.dtype}"))
    return findings


def check_flash(trouble: str | None, device: str, asked: str) -> Finding:
    """flash-attention, of which `trouble` says why it cannot be used; None where it can."""
    if asked == "flash_attention_2" and (trouble is not None or device != "cuda"):
        why = trouble or f"it needs CUDA, found {device}"
        remedy = f"set vlm.attention to auto, or {FLASH}"
        return missing("flash_attn", f"vlm.attention asks for it: {why}", remedy)
    if trouble is None:
        return ok("flash_attn", "installed; taken on CUDA in half precision")
    if device != "cuda":
        return ok("flash_attn", f"{trouble}; it would need CUDA")
    return note("flash_attn", f"{trouble}; optional, sdpa serves", FLASH)


def flash_trouble() -> str | None:
    """Why flash-attention cannot be used; None where it can."""
    if not importable("flash_attn"):
        return "not installed"
    try:
        import_module("flash_attn")
    except (ImportError, OSError) as error:
        return f"installed, but built for another torch or CUDA ({str(error).splitlines()[0]})"
    return None


def _sdpa(device: torch.device) -> str:
    if device.type != "cuda":
        return "torch's kernels for the CPU"
    kernels = [name for name, there in _KERNELS.items() if there()]
    return f"torch's kernels for CUDA: {', '.join(kernels)}"
