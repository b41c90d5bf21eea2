"""A camera frame -> the one size that a checkpoint's image processor makes of it.

The CPU only stretches (Pillow), and needs no torch; `patches` does the rest where the model is.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.base.errors import VLMError


@dataclass(frozen=True)
class PixelSettings:
    """What a checkpoint's image processor does, and the one size that frames are stretched to."""

    resize: tuple[int, int]
    """Height and width asked for."""
    image_size: tuple[int, int]
    """Height and width that the processor makes of it: multiples of patch size x merge size."""
    patch_size: int
    merge_size: int
    temporal_patch_size: int
    rescale_factor: float
    image_mean: tuple[float, ...]
    image_std: tuple[float, ...]

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        return self.image_size[0] // self.patch_size, self.image_size[1] // self.patch_size

    @property
    def merged_grid(self) -> tuple[int, int]:
        """Rows and columns of image tokens."""
        return self.grid[0] // self.merge_size, self.grid[1] // self.merge_size

    def document(self) -> dict[str, Any]:
        """The settings as JSON-able values."""
        fields = asdict(self) | {"resample": "bicubic"}
        return {key: list(v) if isinstance(v, tuple) else v for key, v in fields.items()}

    @classmethod
    def read(cls, folder: Path, resize: tuple[int, int]) -> "PixelSettings":
        """The settings of a checkpoint folder for frames asked for at `resize` (height, width)."""
        from transformers import AutoImageProcessor
        from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import smart_resize

        try:
            processor: Any = AutoImageProcessor.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise VLMError(
                f"{folder}: preprocessor_config.json is missing or cannot be read: {error}"
            ) from error
        if not type(processor).__name__.startswith("Qwen2VLImageProcessor"):
            raise VLMError(
                f"{folder / 'preprocessor_config.json'}: expected a Qwen2VLImageProcessor, found "
                f"{type(processor).__name__}"
            )
        if not (processor.do_rescale and processor.do_normalize and processor.do_resize):
            raise VLMError(
                f"{folder / 'preprocessor_config.json'}: expected do_resize, do_rescale and "
                "do_normalize to be true, as in every Qwen2.5-VL"
            )
        try:
            image_size = smart_resize(
                *resize,
                factor=processor.patch_size * processor.merge_size,
                min_pixels=processor.size["shortest_edge"],
                max_pixels=processor.size["longest_edge"],
            )
        except ValueError as error:
            raise VLMError(
                f"vlm.image_resize_height and _width {resize[0]} x {resize[1]}: {error}"
            ) from error
        return cls(
            resize=resize,
            image_size=image_size,
            patch_size=processor.patch_size,
            merge_size=processor.merge_size,
            temporal_patch_size=processor.temporal_patch_size,
            rescale_factor=processor.rescale_factor,
            image_mean=tuple(processor.image_mean),
            image_std=tuple(processor.image_std),
        )


def stretch(frame: NDArray[np.uint8], image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """The frame (height, width, 3) RGB at `image_size`, by one antialiased bicubic stretch."""
    height, width = image_size
    if frame.shape[:2] == image_size:
        return np.ascontiguousarray(frame)
    image = Image.fromarray(frame).resize((width, height), Image.Resampling.BICUBIC)
    return np.asarray(image)
