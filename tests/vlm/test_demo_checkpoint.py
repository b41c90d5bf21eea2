"""The demo's checkpoint is small, reproducible, and sees where things are."""

from typing import Any

import torch
from transformers import AutoTokenizer

from pipeline.vlm.demo_checkpoint import write_demo_checkpoint


def _bytes(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_same_seed_same_bytes(demo_checkpoint, tmp_path):
    before = torch.random.get_rng_state()
    write_demo_checkpoint(tmp_path / "again")
    assert _bytes(tmp_path / "again") == _bytes(demo_checkpoint)
    write_demo_checkpoint(tmp_path / "again", seed=1)
    other = _bytes(tmp_path / "again")
    changed = {name for name, content in _bytes(demo_checkpoint).items() if other[name] != content}
    assert changed == {"model.safetensors"}
    assert [path.name for path in tmp_path.iterdir()] == ["again"]
    assert torch.equal(torch.random.get_rng_state(), before)


def test_the_tokenizer_has_merges_and_keeps_any_text(demo_checkpoint):
    tokenizer: Any = AutoTokenizer.from_pretrained(demo_checkpoint)
    text = "Insert the needle 12.5 mm into the phantom, Größe µ 针\n"
    ids = tokenizer(text)["input_ids"]
    assert tokenizer.decode(ids) == text
    assert len(tokenizer("insert the needle into the phantom")["input_ids"]) < 12
    assert len(tokenizer) > 600
