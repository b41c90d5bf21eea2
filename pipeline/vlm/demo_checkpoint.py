"""A small Qwen2.5-VL with random weights, written locally in the hub's own format.

Same config, tokenizer, chat template, image processor and safetensors layout as the released
checkpoints, so the demo runs through the code that real weights run through. It has learned
nothing; its random projections still carry what stands where in the image, which the `grid`
pooling keeps.
"""

import json
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tokenizers import AddedToken, Regex, Tokenizer, decoders, normalizers, pre_tokenizers, trainers
from tokenizers.models import BPE
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from pipeline.base.durable import replace_folder
from pipeline.base.ownership import OutputKind
from pipeline.vlm.loading import quiet_transformers

_TOKEN_NAMES = """
endoftext im_start im_end object_ref_start object_ref_end box_start box_end quad_start quad_end
vision_start vision_end vision_pad image_pad video_pad
"""
_SPECIAL_TOKENS = tuple(f"<|{name}|>" for name in _TOKEN_NAMES.split())

_CHAT_TEMPLATE = (
    "{% for message in messages %}"
    "{% if loop.first and message['role'] != 'system' %}"
    "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n{% endif %}"
    "<|im_start|>{{ message['role'] }}\n"
    "{% if message['content'] is string %}{{ message['content'] }}<|im_end|>\n"
    "{% else %}{% for content in message['content'] %}"
    "{% if content['type'] == 'image' or 'image' in content or 'image_url' in content %}"
    "<|vision_start|><|image_pad|><|vision_end|>"
    "{% elif content['type'] == 'video' or 'video' in content %}"
    "<|vision_start|><|video_pad|><|vision_end|>"
    "{% elif 'text' in content %}{{ content['text'] }}{% endif %}{% endfor %}<|im_end|>\n"
    "{% endif %}{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)

_PRETOKENIZE = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*"
    r"|\s*[\r\n]+|\s+(?!\S)|\s+"
)

_TEXT = """
a about above across action after again against align all along already also an and angle any
approach arm around as aside assistant at away axis back base be before begin behind below beside
between bottle bottom bowl box button by camera can carefully carry center chunk clamp clean close
closed cloth cold color contact container control corner cup current cut deep degrees depth desired
direction distance do door down drawer drop each edge end episode every eye face fast few final find
finger first fixture follow for force forward frame from front fully gel gently get give go goal
green grip gripper hand handle heavy helpful here high hold hole horizontal image in insert
insertion inside instruction into is it item joint keep kitchen knife large layer left level lid
lift light like line little lower make measure middle millimeter model motion move near needle next
object of off old on once one only onto open orange out over pan part past peg phantom pick picture
piece place plane plate point pose position pot press pull puncture push put rack reach red relative
release remove retina return right robot rotate round same scene screw second seen select sensor
shelf show side signal silicone simulated sink slide slowly small soft spoon stack start state step
stop surface system table take target task that the then there third this through tick tilt time
tip tissue to together tool top touch toward tray turn twist two under until up upper upright use
user vertical view wait wall water where while white wide will wipe with within wooden yellow you
"""
"""What the tokenizer learns its merges from."""

_MEAN = [0.48145466, 0.4578275, 0.40821073]
_STD = [0.26862954, 0.26130258, 0.27577711]
_VOCABULARY = 1536


def write_demo_checkpoint(folder: Path, seed: int = 0) -> None:
    """Write the demo's checkpoint to `folder`, whole or not at all; same seed, same bytes.

    One that stood there before is replaced. Raises `DiskFull`, and `ConfigError` where something
    else stands there.
    """
    replace_folder(folder, partial(_write, seed=seed), DEMO_CHECKPOINT)


def _is_demo(folder: Path) -> bool:
    config = folder / "config.json"
    return config.is_file() and f'"vocab_size": {_VOCABULARY}' in config.read_text("utf-8")


DEMO_CHECKPOINT = OutputKind("what the demo wrote", _is_demo)
"""Called as the demo's other outputs are: it is written into one that is in the making."""


def _write(folder: Path, seed: int) -> None:
    tokenizer = _train_tokenizer()
    tokenizer.save(str(folder / "tokenizer.json"))
    _write_json(folder / "tokenizer_config.json", _tokenizer_config())
    _write_json(folder / "preprocessor_config.json", _processor_config())
    with quiet_transformers():
        _model(tokenizer, seed).save_pretrained(folder)


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _train_tokenizer() -> Tokenizer:
    """Byte-level BPE with Qwen's normaliser, splitting and special tokens, on a fixed corpus."""
    tokenizer = Tokenizer(BPE())
    tokenizer.normalizer = normalizers.NFC()
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(_PRETOKENIZE), behavior="isolated"),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=_VOCABULARY - len(_SPECIAL_TOKENS),
        min_frequency=2,
        show_progress=False,
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
    )
    tokenizer.train_from_iterator(_corpus(), trainer)
    # Behind the vocabulary, as in the released checkpoints.
    tokenizer.add_special_tokens([AddedToken(token, special=True) for token in _SPECIAL_TOKENS])
    return tokenizer


def _corpus() -> Iterator[str]:
    """The same sentences in every run: words walk at strides, so that neighbours vary."""
    vocabulary = _TEXT.split()
    count = len(vocabulary)
    for stride in (1, 7, 31, 89):
        words = [vocabulary[(index * stride) % count] for index in range(count)]
        for start in range(0, len(words), 9):
            sentence = " ".join(words[start : start + 9])
            yield f"{sentence.capitalize()}.\n"


def _tokenizer_config() -> dict[str, Any]:
    return {
        "add_bos_token": False,
        "add_prefix_space": False,
        "additional_special_tokens": list(_SPECIAL_TOKENS[1:]),
        "bos_token": None,
        "chat_template": _CHAT_TEMPLATE,
        "clean_up_tokenization_spaces": False,
        "eos_token": "<|im_end|>",
        "errors": "replace",
        "model_max_length": 131072,
        "pad_token": "<|endoftext|>",
        "split_special_tokens": False,
        "tokenizer_class": "Qwen2Tokenizer",
        "unk_token": None,
    }


def _processor_config() -> dict[str, Any]:
    return {
        "min_pixels": 3136,
        "max_pixels": 12845056,
        "patch_size": 14,
        "temporal_patch_size": 2,
        "merge_size": 2,
        "image_mean": _MEAN,
        "image_std": _STD,
        "image_processor_type": "Qwen2VLImageProcessor",
    }


def _config(tokenizer: Tokenizer) -> Qwen2_5_VLConfig:
    text = {
        "vocab_size": _VOCABULARY,
        "hidden_size": 128,
        "intermediate_size": 512,
        "num_hidden_layers": 4,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "rms_norm_eps": 1e-6,
        "max_position_embeddings": 128000,
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 1000000.0,
            "mrope_section": [4, 6, 6],
        },
        "bos_token_id": tokenizer.token_to_id("<|endoftext|>"),
        "eos_token_id": tokenizer.token_to_id("<|im_end|>"),
    }
    vision = {
        "depth": 4,
        "hidden_size": 128,
        "intermediate_size": 384,
        "num_heads": 4,
        "patch_size": 14,
        "spatial_merge_size": 2,
        "temporal_patch_size": 2,
        "window_size": 112,
        "fullatt_block_indexes": [1, 3],
        "out_hidden_size": 128,
        "tokens_per_second": 2,
    }
    return Qwen2_5_VLConfig(
        text_config=text,
        vision_config=vision,
        image_token_id=tokenizer.token_to_id("<|image_pad|>"),
        video_token_id=tokenizer.token_to_id("<|video_pad|>"),
        vision_start_token_id=tokenizer.token_to_id("<|vision_start|>"),
        vision_end_token_id=tokenizer.token_to_id("<|vision_end|>"),
        tie_word_embeddings=True,
        dtype="float32",
    )


def _model(tokenizer: Tokenizer, seed: int) -> Qwen2_5_VLForConditionalGeneration:
    """Random weights that keep the scale of what passes through them.

    Drawn by numpy, tensor by tensor: the same on every machine, whatever order torch builds in.
    """
    with torch.random.fork_rng(devices=[]):
        model = Qwen2_5_VLForConditionalGeneration(_config(tokenizer))
    for index, (name, parameter) in enumerate(sorted(model.named_parameters())):
        generator = np.random.default_rng([seed, index])
        with torch.no_grad():
            if "norm" in name or "ln_q" in name:
                parameter.fill_(1)
            elif name.endswith("bias"):
                parameter.zero_()
            else:
                values = generator.standard_normal(parameter.shape, dtype=np.float32)
                fan_in = 1 if "embed_tokens" in name else parameter[0].numel()
                parameter.copy_(torch.from_numpy(values * (1 / math.sqrt(fan_in))))
    return model
