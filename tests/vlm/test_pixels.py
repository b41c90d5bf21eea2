"""Pixels are those of transformers' own image processor."""

from typing import Any

import numpy as np
import pytest
import torch
from transformers import AutoImageProcessor

from pipeline.base.errors import VLMError
from pipeline.vlm.processor import PixelSettings, stretch
from pipeline.vlm.qwen import patchify


def test_patches_equal_the_image_processor(demo_checkpoint, make_frame):
    frames = [make_frame(seed, 360, 640) for seed in range(2)]
    settings = PixelSettings.read(demo_checkpoint, (360, 640))
    stretched = np.stack([stretch(frame, settings.image_size) for frame in frames])
    processor: Any = AutoImageProcessor.from_pretrained(demo_checkpoint)
    expected = processor(images=frames, return_tensors="pt")
    assert expected["image_grid_thw"].tolist() == [[1, *settings.grid]] * 2
    torch.testing.assert_close(
        patchify(torch.from_numpy(stretched), settings),
        expected["pixel_values"],
        atol=1e-6,
        rtol=1e-6,
    )


def test_another_aspect_is_stretched_once(make_frame):
    frame = make_frame(3, 90, 300)
    assert stretch(frame, (112, 140)).shape == (112, 140, 3)
    assert np.array_equal(stretch(frame, (90, 300)), frame)


def test_a_size_past_the_processors_limits_is_refused(demo_checkpoint):
    with pytest.raises(VLMError, match="image_resize_height"):
        PixelSettings.read(demo_checkpoint, (28, 28000))
