"""The arithmetic of one row: floating-point operations of Qwen2.5-VL, part by part.

A multiply-add counts as two. Counted are matrix products, as model FLOPs utilisation does
(Chowdhery et al., PaLM, appendix B; Kaplan et al., Scaling Laws, section 2.1):

    a linear layer            2 x parameters x tokens
    attention, each layer     4 x length^2 x width    (scores, and their sum over values)

Inside the vision tower `length` is a window's (112 pixels: at most 64 patches) but for the few
layers of full attention, where it is an image's. In the decoder it is the row's, without the half
that a causal kernel may leave out: `decoder_attention` says how much that is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Self

PEAK_TFLOPS: Mapping[str, float] = {
    "A100": 312,
    "H100 PCIe": 756,
    "H100": 989,
    "H200": 989,
    "L40S": 362,
    "RTX 4090": 165,
}
"""Dense bfloat16 tensor-core peaks by a part of the device's name, from NVIDIA's data sheets.

The first that fits: an H100 that does not say PCIe is the SXM.
"""


def peak_flops(device_name: str) -> float | None:
    """Peak FLOP/s of a GPU in dense bfloat16; None where the table does not know it."""
    for part, tera in PEAK_TFLOPS.items():
        if part in device_name:
            return tera * 1e12
    return None


@dataclass(frozen=True)
class RowCost:
    """Tokens and operations of one row."""

    tokens: int
    parts: dict[str, int]
    """As `row_flops` gives them."""

    @classmethod
    def of(
        cls,
        config: Any,
        image_size: tuple[int, int],
        images: int,
        text_tokens: int,
        slots: int = 1,
    ) -> Self:
        """Of a forward pass without head; arguments as of `row_flops`."""
        tokens = row_tokens(config, image_size, images, text_tokens)
        return cls(tokens, row_flops(config, image_size, images, text_tokens, slots))

    def total(self, distinct_images: float = 1.0) -> float:
        """Operations in all, where only this share of the images has to be encoded."""
        vision = self.parts["vision_linear"] + self.parts["vision_attention"]
        return sum(self.parts.values()) - vision * (1 - distinct_images)


def row_tokens(config: Any, image_size: tuple[int, int], images: int, text_tokens: int) -> int:
    """Tokens of a row: those of its text, and one for each merged patch of each image."""
    side = config.vision_config.patch_size * config.vision_config.spatial_merge_size
    return text_tokens + images * (image_size[0] // side) * (image_size[1] // side)


def row_flops(
    config: Any,
    image_size: tuple[int, int],
    images: int,
    text_tokens: int,
    slots: int = 0,
    head: bool = False,
) -> dict[str, int]:
    """Operations of one row by part; `config` is a `Qwen2_5_VLConfig`.

    `image_size` is (height, width) as the tower sees it, `slots` are those pooled at one layer, and
    `head` adds the logits of every token. Their sum is what a forward pass costs.
    """
    vision, text = config.vision_config, config.text_config
    tokens = row_tokens(config, image_size, images, text_tokens)
    grid = image_size[0] // vision.patch_size, image_size[1] // vision.patch_size
    parts = {
        "vision_linear": images * _vision_linear(vision, grid),
        "vision_attention": images * _vision_attention(vision, grid),
        "decoder_linear": text.num_hidden_layers * 2 * _layer_parameters(text) * tokens,
        "decoder_attention": text.num_hidden_layers * 4 * tokens**2 * text.hidden_size,
        "pooling": 2 * slots * tokens * text.hidden_size,
    }
    if head:
        parts["head"] = 2 * text.vocab_size * text.hidden_size * tokens
    return parts


def _vision_linear(vision: Any, grid: tuple[int, int]) -> int:
    """Patch embedding, every block's projections, and the merger, of one image."""
    patches = grid[0] * grid[1]
    width, merge = vision.hidden_size, vision.spatial_merge_size**2
    values = vision.in_channels * vision.temporal_patch_size * vision.patch_size**2
    block = 4 * width**2 + 3 * width * vision.intermediate_size
    merger = (merge * width) ** 2 + merge * width * vision.out_hidden_size
    a_patch = values * width + vision.depth * block
    return 2 * a_patch * patches + 2 * merger * (patches // merge)


def _vision_attention(vision: Any, grid: tuple[int, int]) -> int:
    """Of one image: windowed in most layers, full in some."""
    full = len(set(vision.fullatt_block_indexes) & set(range(vision.depth)))
    windowed = vision.depth - full
    # Windows are cut along merged patches, so the smallest of them still holds whole ones.
    side = vision.window_size // vision.patch_size
    rows, columns = (_cut(length, side) for length in grid)
    in_windows = sum((height * width) ** 2 for height, width in product(rows, columns))
    squares = full * (grid[0] * grid[1]) ** 2 + windowed * in_windows
    return 4 * vision.hidden_size * squares


def _cut(length: int, side: int) -> list[int]:
    """A length in pieces of `side`, and the rest."""
    return [min(side, length - start) for start in range(0, length, side)]


def _layer_parameters(text: Any) -> int:
    """Weights of one decoder layer's linear layers, biases left out."""
    width = text.hidden_size
    keys = width * text.num_key_value_heads // text.num_attention_heads
    return 2 * width**2 + 2 * width * keys + 3 * width * text.intermediate_size
