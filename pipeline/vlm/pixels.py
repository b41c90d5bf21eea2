"""A camera frame -> the patches that Qwen2.5-VL's vision tower reads.

The CPU only stretches (Pillow); scaling, normalising and cutting into patches run in torch where
the model is, from uint8. The layout is that of transformers' Qwen2-VL image processor.
"""

from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from pipeline.errors import VLMError


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


def patchify(
    images: UInt8[Tensor, "image height width 3"], settings: PixelSettings
) -> Float[Tensor, "patch value"]:
    """Normalised patches of all images, in float32 on the images' device.

    Patches stand in the tower's order: block by block of merge size x merge size, row-major; the
    values of a patch are (channel, time, y, x), with the still image repeated over time.
    """
    rows, columns = settings.grid
    merge, patch = settings.merge_size, settings.patch_size
    blocks = images.reshape(
        -1, rows // merge, merge, patch, columns // merge, merge, patch, images.shape[-1]
    )
    # image, block row, block column, row in block, column in block, channel, y, x
    patches = blocks.permute(0, 1, 4, 2, 5, 7, 3, 6).to(torch.float32)
    scale, offset = _normalisation(settings, images.device)
    patches = torch.addcmul(offset, patches, scale)
    frames = patches.unsqueeze(6).expand(*[-1] * 6, settings.temporal_patch_size, -1, -1)
    return frames.reshape(len(images) * rows * columns, -1)


@lru_cache(maxsize=8)
def _normalisation(settings: PixelSettings, device: torch.device) -> tuple[Tensor, Tensor]:
    """Scale and offset of each channel (channel, 1, 1), so that one pass rescales and normalises.

    Sent once: sending waits.
    """
    mean, std = (
        torch.tensor(values, dtype=torch.float64).reshape(-1, 1, 1)
        for values in (settings.image_mean, settings.image_std)
    )
    scale, offset = settings.rescale_factor / std, -mean / std
    return scale.float().to(device), offset.float().to(device)
