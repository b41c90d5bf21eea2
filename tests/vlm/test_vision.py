"""The tower gives what transformers' own gives, in few calls and without asking the device."""

from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from transformers import Qwen2_5_VLForConditionalGeneration

from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.qwen import Extractor, patchify
from pipeline.vlm.vision import VisionTower, pad_mlps

CPU = torch.device("cpu")
SIZES = [(112, 112), (112, 140), (140, 196), (56, 56), (252, 112)]
"""Pixels: no window at an edge, at one edge, at both (four lengths), one small window, many."""


@pytest.fixture(scope="module")
def load(demo_checkpoint):
    def load(attention="sdpa"):
        whole = Qwen2_5_VLForConditionalGeneration.from_pretrained(
            demo_checkpoint, dtype=torch.float32, attn_implementation=attention
        )
        return whole.model.eval()

    return load


def images(count, size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, *size, 3), generator=generator, dtype=torch.uint8)


def ours(tower, patches, count):
    plan = tower.plan(count, CPU)
    return tower(patches, plan)[torch.from_numpy(plan.place)]


@pytest.mark.parametrize(
    ("size", "count", "attention"),
    [*((size, 2, "sdpa") for size in SIZES), (SIZES[2], 1, "eager"), (SIZES[2], 5, "eager")],
)
def test_tokens_are_those_of_transformers_in_any_batch_and_order(
    load, demo_checkpoint, size, count, attention
):
    settings = PixelSettings.read(demo_checkpoint, size)
    assert settings.image_size == size
    theirs, visual = load(attention).visual, load(attention).visual
    pictures = images(count, size)
    patches = patchify(pictures, settings)
    grids = torch.tensor([(1, *settings.grid)] * count)
    tower = VisionTower(visual, settings.grid)
    with torch.no_grad():
        expected = theirs(patches, grid_thw=grids).pooler_output
        found = ours(tower, patches, count)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
        turned = ours(tower, patchify(pictures.flip(0), settings), count)
        back = turned.unflatten(0, (count, -1)).flip(0).flatten(0, 1)
        torch.testing.assert_close(back, expected, atol=1e-5, rtol=1e-5)


def test_each_window_length_is_one_call(load, demo_checkpoint, monkeypatch):
    settings = PixelSettings.read(demo_checkpoint, (140, 196))
    tower = VisionTower(load().visual, settings.grid)
    shapes: list[tuple[int, int]] = []
    real = torch.nn.functional.scaled_dot_product_attention

    def counted(query, *args, **kwargs):
        shapes.append((query.shape[0], query.shape[2]))
        return real(query, *args, **kwargs)

    monkeypatch.setattr(torch.nn.functional, "scaled_dot_product_attention", counted)
    with torch.no_grad():
        ours(tower, patchify(images(3, (140, 196)), settings), 3)
    # 5 x 7 tokens of 4 patches: windows of 4 x 4, 4 x 3, 1 x 4 and 1 x 3 tokens, of three images.
    windowed, whole = [(3, 12), (3, 16), (3, 48), (3, 64)], [(3, 140)]
    assert shapes == [*windowed, *whole, *windowed, *whole]


def test_gradients_are_those_of_transformers(load, demo_checkpoint):
    settings = PixelSettings.read(demo_checkpoint, (140, 196))
    patches = patchify(images(2, (140, 196)), settings)
    theirs, visual = load().visual, load().visual
    tower = VisionTower(visual, settings.grid)
    found = ours(tower, patches, 2)
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(1))
    (found * weights).sum().backward()
    expected = theirs(patches, grid_thw=torch.tensor([(1, *settings.grid)] * 2)).pooler_output
    (expected * weights).sum().backward()
    for (name, mine), (its, other) in zip(
        visual.named_parameters(), theirs.named_parameters(), strict=True
    ):
        assert name == its
        assert mine.grad is not None
        scale = float(other.grad.abs().max())
        torch.testing.assert_close(mine.grad, other.grad, atol=1e-4 * scale, rtol=1e-3)


def test_a_batch_asks_nothing_of_its_device(extractor, make_frame, monkeypatch):
    """Tensors of the meta device have no values: reading one back raises."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # which it has not
    made = extractor(pooling=["mean", "grid"], layers=[-1, 1], norms=[True, False], anew=True)
    frames = {view: make_frame(seed) for seed, view in enumerate(("View1", "View2", "View3"))}
    rows = [
        made.preparer.prepare("insert the needle", frames),
        made.preparer.prepare("stop", {"View2": frames["View2"]}),
    ]
    settings = PixelSettings.read(Path(made.vlm.checkpoint), (112, 140))
    nowhere = Extractor(made.model._model, settings, made.spec.slots)
    made.model._model.to("meta")
    with torch.no_grad():
        features, valid = nowhere.extract(rows)
    assert features.device.type == "meta"
    assert features.shape == (2, len(made.spec.slots), made.spec.dim)
    assert valid.device.type == "cpu"
    with pytest.raises((RuntimeError, NotImplementedError)):
        features.sum().item()


def test_padded_mlps_give_the_same(load, demo_checkpoint):
    settings = PixelSettings.read(demo_checkpoint, SIZES[0])
    visual = load().visual.requires_grad_(False)
    for block in visual.blocks:  # a width that is no multiple of 64
        for layer in (block.mlp.gate_proj, block.mlp.up_proj):
            layer.weight.data, layer.bias.data = layer.weight[:-4], layer.bias[:-4]
        block.mlp.down_proj.weight.data = block.mlp.down_proj.weight[:, :-4]
    patches = patchify(images(2, SIZES[0]), settings)
    before = ours(VisionTower(visual, settings.grid), patches, 2)
    pad_mlps(visual)
    assert {len(block.mlp.up_proj.weight) % 64 for block in visual.blocks} == {0}
    torch.testing.assert_close(ours(VisionTower(visual, settings.grid), patches, 2), before)
