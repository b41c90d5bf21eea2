"""Stretched frames -> the patches that Qwen2.5-VL's vision tower reads.

Scaling, normalising and cutting into patches run in torch where the model is, from uint8. The
layout is that of transformers' Qwen2-VL image processor.
"""

from functools import lru_cache

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pipeline.vlm.pixels import PixelSettings


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
