"""The demo's checkpoint is small, reproducible, and sees where things are."""

from typing import Any

import numpy as np
import torch
from safetensors import safe_open
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


def test_it_has_the_hubs_layout_and_a_few_million_parameters(demo_checkpoint):
    assert {path.name for path in demo_checkpoint.iterdir()} == {
        "config.json",
        "generation_config.json",
        "model.safetensors",
        "preprocessor_config.json",
        "tokenizer.json",
        "tokenizer_config.json",
    }
    with safe_open(demo_checkpoint / "model.safetensors", "pt") as weights:
        names = list(weights.keys())
        parameters = sum(weights.get_tensor(name).numel() for name in names)
    assert {"visual.patch_embed.proj.weight", "model.layers.0.self_attn.q_proj.bias"} <= set(names)
    assert 1e6 < parameters < 1e7


def test_the_tokenizer_has_merges_and_keeps_any_text(demo_checkpoint):
    tokenizer: Any = AutoTokenizer.from_pretrained(demo_checkpoint)
    text = "Insert the needle 12.5 mm into the phantom, Größe µ 针\n"
    ids = tokenizer(text)["input_ids"]
    assert tokenizer.decode(ids) == text
    assert len(tokenizer("insert the needle into the phantom")["input_ids"]) < 12
    assert len(tokenizer) > 600


def _disc(x, y):
    rows, columns = (np.mgrid[0:112, 0:140] + 0.5) / np.array([112, 140])[:, None, None]
    image = np.full((112, 140, 3), 90, np.uint8)
    image[(columns - x) ** 2 + (rows - y) ** 2 < 0.08**2] = (220, 60, 40)
    return image


def _ridge_r2(features, places):
    """R² on the last quarter of a ridge regression fitted on the rest."""
    fitted = len(features) * 3 // 4
    train, test = features[:fitted], features[fitted:]
    mean, spread = train.mean(0), train.std(0) + 1e-6
    train, test = (train - mean) / spread, (test - mean) / spread
    target = places[:fitted].mean(0)
    kernel = train @ train.T + 10 * np.eye(fitted)
    dual = np.linalg.solve(kernel, places[:fitted] - target)
    error = test @ train.T @ dual + target - places[fitted:]
    return float(1 - (error**2).sum() / ((places[fitted:] - places[fitted:].mean(0)) ** 2).sum())


def test_grid_finds_a_disc_and_mean_does_so_less(extractor):
    eye = extractor(views=("View1",), pooling=["mean", "grid"])
    places = np.random.default_rng(0).uniform(0.12, 0.88, (160, 2))
    rows = [eye.preparer.prepare("insert", {"View1": _disc(x, y)}) for x, y in places]
    features = torch.cat([eye.model.encode(rows[i : i + 40])[0] for i in range(0, 160, 40)])
    table = features.numpy().astype(np.float64)
    mean = _ridge_r2(table[:, 0], places)
    grid = _ridge_r2(table[:, 1:].reshape(len(table), -1), places)
    assert grid > 0.85
    assert grid > mean + 0.1
