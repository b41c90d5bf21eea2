"""Equal images reach the tower once; a batch of equal layout keeps its shape."""

from contextlib import suppress

import jaxtyping
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.base.config import VLMParams
from pipeline.base.digests import file_digest
from pipeline.base.errors import VLMError
from pipeline.vlm.collation import Collator, unique
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM
from pipeline.vlm.vision import VisionTower


@given(st.lists(arrays(np.uint8, (2, 3, 3), elements=st.integers(0, 1)), max_size=12))
def test_unique_says_which_image_is_which(images):
    distinct, which = unique(images)
    assert len(distinct) == len({image.tobytes() for image in images})
    assert all(
        np.array_equal(distinct[one], image) for one, image in zip(which, images, strict=True)
    )


def test_images_that_differ_where_nobody_looks_are_told_apart():
    image = np.zeros((80, 80, 3), np.uint8)
    other = image.copy()
    other[0, 0, 1] = 1
    distinct, which = unique([image, other, image.copy()])
    assert len(distinct) == 2
    assert which == [0, 1, 0]


def test_equal_images_of_a_batch_are_seen_once(extractor, make_frame, monkeypatch):
    seen: list[int] = []  # images in each pass of the tower
    real = VisionTower.plan

    def plan(self, images, device):
        seen.append(images)
        return real(self, images, device)

    monkeypatch.setattr(VisionTower, "plan", plan)
    ours = extractor(pooling=["mean", "view_mean"])
    a, b, c = (make_frame(seed) for seed in range(3))
    rows = [
        ours.preparer.prepare("insert", {"View1": a, "View2": b, "View3": a}),
        ours.preparer.prepare("pull it out", {"View1": a, "View3": c}),
        ours.preparer.prepare("hold", {}),
        ours.preparer.prepare("hold", {"View2": c}),
    ]
    together, _ = ours.model.encode(rows)
    assert seen == [3]
    alone = torch.cat([ours.model.encode([row])[0] for row in rows])
    assert seen == [3, 2, 2, 1]
    torch.testing.assert_close(together, alone, atol=2e-5, rtol=1e-4)


def compare_with_compiled(vlm: VLMParams, frames: list[dict[str, np.ndarray]]) -> None:
    spec = feature_spec(vlm, "float32", VIEWS, file_digest)
    compiled, plain = (FrozenVLM.load(vlm, spec, "cpu", compile=how) for how in (True, False))
    preparer = Preparer(vlm, spec)
    rows = [preparer.prepare("insert the needle", one) for one in frames]
    for batch in (rows, rows[:1], rows[1:], [rows[0]] * 4):
        found, valid = compiled.encode(batch)
        expected, expected_valid = plain.encode(batch)
        torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-4)
        assert torch.equal(valid, expected_valid)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 2
    assert not torch._dynamo.utils.counters["graph_break"]


@pytest.mark.slow
def test_a_compiled_model_gives_the_same_features_and_is_compiled_once_a_shape(
    vlm_params, make_frame, fork_server
):
    """In a process without the checks of shapes, which the compiler cannot look into."""
    vlm = vlm_params(pooling=["mean", "grid"], layers=[-1, 1], norms=[True, False])
    frames = [{view: make_frame(7 * i + j) for j, view in enumerate(VIEWS)} for i in range(4)]
    process = fork_server.Process(target=compare_with_compiled, args=(vlm, frames))
    process.start()
    process.join()
    assert process.exitcode == 0


@pytest.mark.filterwarnings("ignore:`torch.jit.script_method`:DeprecationWarning")
def test_a_compiled_model_is_given_sizes_that_it_has_seen_and_that_fit(
    extractor, make_frame, monkeypatch
):
    monkeypatch.setattr(torch, "compile", lambda part, **options: part)
    plain = extractor(pooling=["mean"])
    compiled = FrozenVLM.load(plain.vlm, plain.spec, "cpu", compile=True)
    given, real, room = [], Collator.collate, [99]

    def collate(self, rows):
        given.append(len(rows))
        if len(rows) > room[0]:
            raise torch.OutOfMemoryError("too many")
        return real(self, rows)

    monkeypatch.setattr(Collator, "collate", collate)
    row = plain.preparer.prepare("insert the needle", {"View1": make_frame(0)})
    for size in (2, 8, 4, 3, 5, 8, 1):
        compiled.encode([row] * size)
    assert given == [2, 8, 8, 8, 8, 8, 2]
    room[0] = 4
    for size in (8, 4, 3):
        with suppress(torch.OutOfMemoryError):
            compiled.encode([row] * size)
    assert given[7:] == [8, 4, 4], "what did not fit is not padded to again"


@pytest.fixture
def no_shape_checks():
    """As the compiler cannot look into them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.slow
@pytest.mark.usefixtures("no_shape_checks")
@pytest.mark.filterwarnings("ignore:`torch.jit.script_method`:DeprecationWarning")
def test_no_compiler_is_said(extractor, make_frame, monkeypatch, tmp_path):
    from torch._inductor import config

    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    plain = extractor(pooling=["mean"])
    compiled = FrozenVLM.load(plain.vlm, plain.spec, "cpu", compile=True)
    row = plain.preparer.prepare("insert the needle", {"View1": make_frame(0)})
    refused = pytest.raises(VLMError, match=r"cannot be compiled here: .*set extract\.compile to")
    with config.patch("cpp.cxx", (str(tmp_path / "no_compiler"),)), refused:
        compiled.encode([row])


VIEWS = ("View1", "View2", "View3")
