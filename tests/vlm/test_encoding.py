"""Features do not depend on their batch, and are those of a plain transformers forward."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from transformers import AutoImageProcessor, AutoTokenizer, Qwen2_5_VLForConditionalGeneration

from pipeline.base.errors import NumericsError, VLMError

POOLINGS = ("mean", "image_mean", "text_mean", "view_mean", "grid", "last")
VIEWS = ("View1", "View2", "View3")
Frames = Mapping[str, NDArray[np.uint8]]
Row = tuple[str, Frames]


@pytest.fixture(scope="module")
def rows(make_frame):
    """Rows of different length, with all views, some, one, and none."""
    frames = {view: make_frame(seed) for seed, view in enumerate(VIEWS)}
    others = {view: make_frame(seed, 300, 200) for seed, view in enumerate(VIEWS, start=7)}
    return [
        ("insert the needle", frames),
        ("move slowly to the left, then insert the needle into the phantom", others),
        ("stop", {"View2": frames["View2"]}),
        ("retract", {"View1": others["View1"], "View3": frames["View3"]}),
        ("hold the position", {}),
        ("insert the needle", others),
    ]


class Reference:
    """A plain transformers forward, one row at a time, with no code of ours."""

    def __init__(self, folder, size):
        self.processor: Any = AutoImageProcessor.from_pretrained(folder)
        self.tokenizer: Any = AutoTokenizer.from_pretrained(folder)
        whole = Qwen2_5_VLForConditionalGeneration.from_pretrained(folder, dtype=torch.float32)
        self.model: Any = whole.model.eval()
        self.size = size

    def hidden(self, instruction, frames):
        """The output (token, dim) of embeddings and of each layer before the norm, which tokens
        are of images, and tokens an image."""
        content = [
            {"type": "text", "text": f"{instruction}\n"},
            *({"type": "image"} for _ in frames),
            {"type": "text", "text": f"\n{instruction}"},
        ]
        messages = [{"role": "user", "content": content}]
        text = self.tokenizer.apply_chat_template(messages, tokenize=False)
        inputs, per_image = {}, 0
        if frames:
            height, width = self.size
            images = [
                Image.fromarray(frame).resize((width, height), Image.Resampling.BICUBIC)
                for frame in frames.values()
            ]
            inputs = self.processor(images=images, do_resize=False, return_tensors="pt")
            per_image = int(inputs["image_grid_thw"][0].prod()) // 4
            text = text.replace("<|image_pad|>", "<|image_pad|>" * per_image)
        ids = torch.tensor([self.tokenizer(text)["input_ids"]])
        is_image = ids == self.tokenizer.convert_tokens_to_ids("<|image_pad|>")
        last: list[Tensor] = []
        hook = self.model.language_model.norm.register_forward_pre_hook(
            lambda _module, given: last.append(given[0])
        )
        with torch.no_grad():
            out = self.model(
                input_ids=ids,
                attention_mask=torch.ones_like(ids),
                mm_token_type_ids=is_image.int(),
                output_hidden_states=True,
                **inputs,
            )
        hook.remove()
        # The last of the hidden states is after the norm, the first is the embedding.
        layers = [*out.hidden_states[:-1], last[0]]
        return [layer[0] for layer in layers], is_image[0], per_image

    def pooled(self, instruction, frames, layer, norm):
        layers, is_image, per_image = self.hidden(instruction, frames)
        tokens = layers[1 + layer]
        if norm:
            with torch.no_grad():
                tokens = self.model.language_model.norm(tokens)
        none = torch.zeros(tokens.shape[1])
        shown = tokens[is_image].split(per_image) if frames else ()
        images = dict(zip(frames, shown, strict=True))
        rows, columns = self.size[0] // 28, self.size[1] // 28
        slots = [tokens.mean(0), tokens[is_image].mean(0) if frames else none]
        slots += [tokens[~is_image].mean(0)]
        slots += [images[view].mean(0) if view in images else none for view in VIEWS]
        for view in VIEWS:
            if view not in images:
                slots += [none] * 16
                continue
            plane = images[view].reshape(rows, columns, -1).permute(2, 0, 1)
            cells = torch.nn.functional.adaptive_avg_pool2d(plane, 4)
            slots += list(cells.flatten(1).T)
        return torch.stack([*slots, tokens[-1]])


def test_batch_equals_single_rows_and_plain_transformers(extractor, rows, demo_checkpoint):
    ours = extractor(pooling=POOLINGS, layers=[-1, 1], norms=[True, False])
    assert ours.spec.image_size == (112, 140)
    prepared = [ours.preparer.prepare(*row) for row in rows]
    features, valid = ours.model.encode(prepared)
    assert features.shape == (6, 4 * (1 + 1 + 1 + 3 + 48 + 1), 128)

    for index, row in enumerate(prepared):
        alone, alone_valid = ours.model.encode([row])
        torch.testing.assert_close(features[index], alone[0], atol=2e-5, rtol=1e-4)
        assert torch.equal(valid[index], alone_valid[0])
    backwards, _ = ours.model.encode(prepared[::-1])
    torch.testing.assert_close(features, backwards.flip(0), atol=2e-5, rtol=1e-4)

    reference = Reference(demo_checkpoint, ours.spec.image_size)
    for index, row in enumerate(rows):
        expected = torch.cat(
            [reference.pooled(*row, layer, norm) for layer in (3, 1) for norm in (True, False)]
        )
        torch.testing.assert_close(features[index], expected, atol=2e-5, rtol=1e-4)
        present = expected.any(dim=-1)
        assert torch.equal(valid[index], present)
        assert not features[index][~present].any()


def test_tokens_and_the_vision_tower_are_those_of_plain_transformers(
    extractor, rows, demo_checkpoint
):
    ours = extractor(pooling=[{"grid": [2, 1]}, "tokens"], layers=["vision", 1], norms=[False])
    tokens, dim = 4 * 5, 128
    assert len(ours.spec.slots) == 2 * (3 * 2 + 3 * tokens)
    assert [slot.layer for slot in ours.spec.slots[::66]] == ["vision", 1]
    reference = Reference(demo_checkpoint, ours.spec.image_size)
    for row in rows[:4]:
        features, valid = ours.model.encode([ours.preparer.prepare(*row)])
        layers, is_image, per_image = reference.hidden(*row)
        for index, hidden in enumerate((layers[0], layers[2])):  # as the tower gave it; after 1
            ours_by_view = features[0].view(2, 66, dim)[index]
            halves, alone = ours_by_view[:6].view(3, 2, dim), ours_by_view[6:].view(3, tokens, dim)
            shown = iter(hidden[is_image].split(per_image or 1))
            for view, name in enumerate(VIEWS):
                expected = next(shown) if name in row[1] else torch.zeros(tokens, dim)
                torch.testing.assert_close(alone[view], expected, atol=2e-5, rtol=1e-4)
                mean = expected.view(2, -1, dim).mean(dim=1)
                torch.testing.assert_close(halves[view], mean, atol=2e-5, rtol=1e-4)
        assert torch.equal(valid[0], features[0].any(dim=-1))
    alone = extractor(pooling=["tokens"], layers=["vision"], anew=True)
    assert len(alone.model._model.language_model.layers) == 0  # the language model does not run


def test_one_store_may_hold_no_view_at_all(extractor):
    blind = extractor(views=(), pooling=["mean", "image_mean"])
    row = blind.preparer.prepare("insert the needle", {})
    features, valid = blind.model.encode([row, row])
    assert valid.tolist() == [[True, False]] * 2
    assert features[0, 0].abs().max() > 0
    assert not features[:, 1].any()
    with pytest.raises(VLMError, match="without a view"):
        extractor(views=(), pooling=["grid"])


def test_an_infinite_feature_names_row_and_slot(extractor, rows):
    narrow = extractor("float16", pooling=["mean", "view_mean"], norms=[False], anew=True)
    prepared = [narrow.preparer.prepare(*row) for row in rows]
    narrow.model.encode(prepared)
    text = narrow.model._model.language_model
    only_in_row_2 = sorted(
        set(prepared[2].token_ids.tolist())
        - {int(token) for row in (prepared[0], prepared[4]) for token in row.token_ids}
    )
    with torch.no_grad():
        text.embed_tokens.weight[only_in_row_2] *= 1e9
    batch = [prepared[0], prepared[4], prepared[2]]
    with pytest.raises(NumericsError, match=r"row 2 of the batch, slot .*'pooling': 'mean'"):
        narrow.model.encode(batch)


def test_a_row_with_a_strange_view_is_refused(extractor, rows):
    ours = extractor()
    with pytest.raises(VLMError, match="View9 is not in the feature spec"):
        ours.preparer.prepare("stop", {"View9": rows[0][1]["View1"]})
    with pytest.raises(VLMError, match="uint8 RGB"):
        ours.preparer.prepare("stop", {"View1": np.zeros((8, 8), np.uint8)})
