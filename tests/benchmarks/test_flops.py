"""The counted arithmetic is what torch counts when the model runs, at the real shape too."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from transformers import Qwen2_5_VLForConditionalGeneration

from benchmarks.flops import row_flops


@pytest.fixture(scope="module")
def demo_model(demo_checkpoint: Path) -> Any:
    return Qwen2_5_VLForConditionalGeneration.from_pretrained(demo_checkpoint, dtype="float32")


def counted(model: Any, image_size: tuple[int, int], images: int, text_tokens: int) -> int:
    """What torch counts in the fused kernels' stead, logits included."""
    config = model.config
    vision = config.vision_config
    grid = [1, image_size[0] // vision.patch_size, image_size[1] // vision.patch_size]
    merged = grid[1] * grid[2] // vision.spatial_merge_size**2
    values = 3 * vision.temporal_patch_size * vision.patch_size**2
    shown = [config.vision_start_token_id, *[config.image_token_id] * merged]
    ids = torch.tensor([[*range(text_tokens - images), *(shown * images)]])
    with (
        torch.inference_mode(),
        sdpa_kernel(SDPBackend.MATH),
        FlopCounterMode(display=False) as counter,
    ):
        model(
            input_ids=ids,
            pixel_values=torch.randn(images * grid[1] * grid[2], values),
            image_grid_thw=torch.tensor([grid] * images),
            mm_token_type_ids=(ids == config.image_token_id).int(),
        )
    return counter.get_total_flops()


@pytest.mark.parametrize(
    ("image_size", "images"),
    [((112, 168), 3), ((140, 252), 1), ((56, 56), 2)],
)
def test_a_row_costs_what_torch_counts(demo_model, image_size, images):
    expected = counted(demo_model, image_size, images, text_tokens=50)
    found = row_flops(demo_model.config, image_size, images, text_tokens=50, head=True)
    # Rotary positions are a product too, of a few numbers a token.
    assert sum(found.values()) == pytest.approx(expected, rel=2e-4)
