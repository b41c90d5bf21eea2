"""A small Qwen2.5-VL with random weights, written locally in the hub's own format.

It has the same config, tokenizer, chat template, image processor and safetensors layout as the
released checkpoints, so the demo runs the same code as real weights. It has learned nothing, but
its random projections still show where things are in the image, and the `grid` pooling keeps that.
"""

import json
import math
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from tokenizers import AddedToken, Regex, Tokenizer, decoders, normalizers, pre_tokenizers, trainers
from tokenizers.models import BPE
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from pipeline.base.files import OutputKind, replace_folder
from pipeline.vlm.checkpoint_folder import quiet_transformers

_FILES = Path(__file__).with_name("demo")
"""The sources of the checkpoint: its own small files, its architecture, and the words from which
the tokenizer learns its merges."""

_VOCABULARY = 1536

_WORDS = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*"
    r"|\s*[\r\n]+|\s+(?!\S)|\s+"
)
"""The pattern with which Qwen2's tokenizers split a text into words."""


def write_demo_checkpoint(folder: Path, seed: int = 0) -> None:
    """Write the demo's checkpoint to `folder`, completely or not at all; same seed, same bytes.

    An earlier one there is replaced. Raises `DiskFull`, and `ConfigError` where something else is
    there.
    """
    replace_folder(folder, partial(write_checkpoint_files, seed=seed), _CHECKPOINT)


def _is_demo(folder: Path) -> bool:
    config = folder / "config.json"
    return config.is_file() and f'"vocab_size": {_VOCABULARY}' in config.read_text("utf-8")


_CHECKPOINT = OutputKind("the demo's checkpoint", _is_demo)


def write_checkpoint_files(folder: Path, seed: int) -> None:
    """Write the files of the demo's checkpoint into an existing folder."""
    for name in ("tokenizer_config.json", "preprocessor_config.json"):
        shutil.copyfile(_FILES / name, folder / name)
    _train_tokenizer().save(str(folder / "tokenizer.json"))
    quiet_transformers()
    _build_model(seed).save_pretrained(folder)


def _train_tokenizer() -> Tokenizer:
    """Byte-level BPE with Qwen's normaliser, splitting and special tokens, on a fixed corpus."""
    config = json.loads((_FILES / "tokenizer_config.json").read_text(encoding="utf-8"))
    special = (config["pad_token"], *config["additional_special_tokens"])
    tokenizer = Tokenizer(BPE())
    tokenizer.normalizer = normalizers.NFC()
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(_WORDS), behavior="isolated"),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=_VOCABULARY - len(special),
        min_frequency=2,
        show_progress=False,
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
    )
    tokenizer.train_from_iterator(_corpus(), trainer)
    # After the vocabulary, as in the released checkpoints.
    tokenizer.add_special_tokens([AddedToken(token, special=True) for token in special])
    return tokenizer


def _corpus() -> Iterator[str]:
    """The same sentences in every run; several strides through the words vary the neighbours."""
    vocabulary = (_FILES / "words.txt").read_text(encoding="utf-8").split()
    count = len(vocabulary)
    for stride in (1, 7, 31, 89):
        words = [vocabulary[(index * stride) % count] for index in range(count)]
        for start in range(0, len(words), 9):
            sentence = " ".join(words[start : start + 9])
            yield f"{sentence.capitalize()}.\n"


def _build_model(seed: int) -> Qwen2_5_VLForConditionalGeneration:
    """Random weights that keep the scale of their input.

    numpy draws them tensor by tensor: they are the same on every machine, in whatever order torch
    builds.
    """
    config = json.loads((_FILES / "config.json").read_text(encoding="utf-8"))
    with torch.random.fork_rng(devices=[]):
        model = Qwen2_5_VLForConditionalGeneration(Qwen2_5_VLConfig(**config))
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
