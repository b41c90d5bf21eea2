"""Which models the extraction benchmark runs, on which device, and what they are shown."""

from dataclasses import dataclass
from typing import Any

import torch
from transformers import Qwen2_5_VLConfig

from benchmarks.real_shape import random_model
from benchmarks.workload import Workload
from pipeline.base.config import Params
from pipeline.vlm.loading import load_whole
from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.qwen import FrozenVLM


@dataclass(frozen=True)
class Case:
    """A model on a device, and what it is shown."""

    name: str
    device: str
    rows: int
    batch_sizes: tuple[int, ...]
    """Of which `plain` takes the best."""
    wanted: dict[str, float]
    """Least speed against a contender."""
    vlm: dict[str, Any]
    views: int = 3
    frame_size: tuple[int, int] | None = None
    real_shape: bool = False


def demo_case(rows: int) -> Case:
    """The demo's checkpoint and image size on the CPU."""
    small = {"dtype": "float32", "image_resize_height": 112, "image_resize_width": 168}
    wanted = {"seeds": 2.0, "plain": 1.2}
    return Case("demo_cpu", "cpu", rows, (4, 8, 16), wanted, small)


def real_case(views: int, rows: int) -> Case:
    """Qwen2.5-VL-3B's shape on the GPU."""
    half = {"dtype": "bfloat16", "attention": "sdpa"}
    wanted = {"seeds": 3.0, "plain": 1.5}
    sizes = (1, 2, 4, 8, 16, 32)
    name = f"3B_{views}_views"
    return Case(name, "cuda", rows, sizes, wanted, half, views, (360, 640), real_shape=True)


def frozen_model(case: Case, workload: Workload, compiled: bool) -> FrozenVLM:
    """The model as stage one holds it."""
    vlm, spec = workload.params.vlm, workload.survey.spec
    if not case.real_shape:
        return FrozenVLM.load(vlm, spec, case.device, compiled)
    model = whole_model(case, workload.params).model
    return FrozenVLM(model, PixelSettings.of(vlm), spec, compiled)


def whole_model(case: Case, params: Params) -> Any:
    """A whole model; the plain ways have one of their own, which stage one does not set up."""
    if not case.real_shape:
        whole = load_whole(params.vlm, torch.device(case.device))
        return whole.eval().requires_grad_(False)
    torch.manual_seed(0)
    config = Qwen2_5_VLConfig.from_pretrained(params.vlm.checkpoint, trust_remote_code=False)
    return random_model(config, case.device)
