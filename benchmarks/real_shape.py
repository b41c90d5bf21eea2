"""Qwen2.5-VL-3B in its real shape with random weights: for speed, memory and arithmetic.

What a row costs does not depend on what the weights say, so the released checkpoint is not needed.
"""

from pathlib import Path
from typing import Any

import torch
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from pipeline.vlm.demo_checkpoint import write_demo_checkpoint

_TOKENS = ("image_token_id", "video_token_id", "vision_start_token_id", "vision_end_token_id")


def real_config(**tokens: Any) -> Qwen2_5_VLConfig:
    """The config of Qwen/Qwen2.5-VL-3B-Instruct, with other ids of special tokens where given."""
    text = {
        "vocab_size": 151936,
        "hidden_size": 2048,
        "intermediate_size": 11008,
        "num_hidden_layers": 36,
        "num_attention_heads": 16,
        "num_key_value_heads": 2,
        "rms_norm_eps": 1e-6,
        "max_position_embeddings": 128000,
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 1000000.0,
            "mrope_section": [16, 24, 24],
        },
    }
    vision = {
        "depth": 32,
        "hidden_size": 1280,
        "intermediate_size": 3420,
        "num_heads": 16,
        "patch_size": 14,
        "spatial_merge_size": 2,
        "temporal_patch_size": 2,
        "window_size": 112,
        "fullatt_block_indexes": [7, 15, 23, 31],
        "out_hidden_size": 2048,
        "tokens_per_second": 2,
    }
    return Qwen2_5_VLConfig(
        text_config=text, vision_config=vision, tie_word_embeddings=True, **tokens
    )


def write_shell(folder: Path) -> Qwen2_5_VLConfig:
    """Write a checkpoint folder that has all but the weights of the real shape; its config.

    Tokenizer, chat template and image processor are the demo's, and so are the few weights that
    lie there: whoever loads them is told that they do not fit.
    """
    write_demo_checkpoint(folder)
    demo = Qwen2_5_VLConfig.from_pretrained(folder, trust_remote_code=False)
    config = real_config(**{name: getattr(demo, name) for name in _TOKENS})
    config.save_pretrained(folder)
    return config


def random_model(config: Qwen2_5_VLConfig, device: str, dtype: torch.dtype = torch.bfloat16) -> Any:
    """A frozen `Qwen2_5_VLForConditionalGeneration` of this config, made on the device itself.

    On "meta" it has shapes and no memory. The same seed of torch gives the same weights.
    """
    kind: Any = Qwen2_5_VLForConditionalGeneration
    with torch.device(device):
        model = kind._from_config(config, dtype=dtype, attn_implementation="sdpa")
    return model.eval().requires_grad_(False)
