"""A pass is timed with the store's own model, or not at all."""

import pytest

from pipeline.base.config import load_params
from pipeline.base.errors import StoreMismatch
from pipeline.evaluate.probe import timing
from pipeline.evaluate.probe.timing import time_passes
from pipeline.store import FeatureStore
from pipeline.vlm.qwen import Extractor


def test_each_pass_stops_after_its_layer(trained_once, monkeypatch) -> None:
    params, ran = load_params(trained_once), list[int]()
    store = FeatureStore.open(params.extract.store)
    monkeypatch.setattr(timing, "_PASSES", 1)

    class Counted(Extractor):
        def features(self, batch):  # type: ignore
            ran.append(len(self.model.language_model.layers))
            return super().features(batch)

    monkeypatch.setattr(timing, "Extractor", Counted)
    seconds = time_passes(store, params.vlm, [-1, 0, 2], "cpu")
    assert [*seconds] == [-1, 0, 2]
    assert all(took > 0 for took in seconds.values())
    assert ran == [0, 1, 3, 0, 1, 3]

    other = params.vlm.model_copy(update={"dtype": "bfloat16"})
    with pytest.raises(StoreMismatch, match=r"compute_dtype: .float32. -> .bfloat16."):
        time_passes(store, other, [0], "cpu")
    other_slots = params.vlm.model_copy(update={"pooling": ("mean",), "layers": "all"})
    assert time_passes(store, other_slots, [1], "cpu").keys() == {1}
