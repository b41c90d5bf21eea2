"""All contenders of the extraction benchmark compute the same features, in the real shape too."""

import time
from argparse import Namespace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import real_shape, stage_one
from benchmarks.cases import Case
from benchmarks.extract import _deviation, measure
from benchmarks.profiling import Stopwatch
from benchmarks.stage_one import StageOne
from pipeline.extract.rows import RowPreparation
from pipeline.vlm import collation

OPTIONS = Namespace(batch_size=2, rounds=1, profile=True, compile=False)


def small_config(**tokens: Any) -> Any:
    """The real shape, much smaller."""
    config = real_shape_config(**tokens)
    text, vision = config.text_config, config.vision_config
    text.hidden_size = text.intermediate_size = vision.out_hidden_size = 256
    text.num_attention_heads, text.num_key_value_heads, text.vocab_size = 2, 1, 2000
    text.bos_token_id = text.eos_token_id = None
    text.num_hidden_layers = vision.depth = 2
    text.layer_types = text.layer_types[:2]
    vision.hidden_size = vision.intermediate_size = 64
    vision.num_heads, vision.fullatt_block_indexes = 2, [1]
    return config


real_shape_config = real_shape.real_config


def test_a_real_shape_with_five_views_goes_through_every_contender(tmp_path, monkeypatch):
    monkeypatch.setattr(real_shape, "real_config", small_config)
    vlm = {"dtype": "bfloat16", "image_resize_height": 84, "image_resize_width": 140}
    case = Case("small", "cpu", 5, (1, 2), {"seeds": 1.0}, vlm, 5, (90, 160), real_shape=True)
    found = measure(case, tmp_path, OPTIONS)
    ways = {"seeds", "seeds_by_8", "plain", "ours", "ours_every_frame"}
    assert set(found.results) == ways
    assert all(one["rows_per_s"] > 0 for one in found.results.values())
    assert all(one["cpu_ms_a_row"] > 0 for one in found.results.values())
    assert {"plain", "plain, every frame"} <= set(found.ratios)
    assert 0 < found.results["plain"]["preparing_share"] < 1
    assert 0 < found.results["ours"]["model_share"] <= 1
    assert found.settings["views"] == 5
    assert found.settings["image_size"] == (84, 140)
    assert found.settings["distinct_frames_share"] == 1
    assert found.settings["largest_deviation"] > 0
    assert len(found.targets) == 2
    steps = found.settings["profile_s"]
    assert {"decode", "resize", "vision tower", "decoder", "write", "wall"} <= set(steps)
    assert all(seconds > 0 for seconds in steps.values())


def test_contenders_that_differ_are_refused():
    case = Case("case", "cpu", 2, (1,), {}, {"dtype": "float32"})
    plain = np.ones((2, 3), np.float32)
    ran: list[object] = []
    ways: Any = SimpleNamespace(array=lambda: plain, saved=lambda: plain, with_head=ran.append)

    def ours(features: np.ndarray) -> Any:
        return SimpleNamespace(run=lambda: ran.append("ours"), features=lambda: features)

    assert _deviation(case, ways, ours(plain * (1 + 1e-5))) == pytest.approx(1e-5, rel=0.1)
    assert ran == ["ours", 1, 8]
    with pytest.raises(AssertionError, match="contenders differ"):
        _deviation(case, ways, ours(plain * 1.1))


def test_no_frame_and_no_row_is_spared_where_every_frame_is_asked_for():
    ours = object.__new__(StageOne)
    frame = np.zeros((2, 2, 3), np.uint8)
    seen: list[Any] = []

    def run() -> None:
        seen.append(collation.unique([frame, frame])[1])
        seen.append(RowPreparation.prepare is stage_one.prepare_all)

    ours.run = run  # type: ignore[method-assign]
    ours.run_every_frame()
    run()
    assert seen == [[0, 1], True, [0, 0], False]


def test_a_step_is_charged_without_the_steps_that_it_calls():
    watch = Stopwatch()
    inner = watch.timed("inner", lambda: time.sleep(0.05))
    outer = watch.timed("outer", lambda: inner())
    begun = time.perf_counter()
    outer()
    outer()
    whole = time.perf_counter() - begun
    assert watch.seconds["inner"] >= 0.1
    assert watch.seconds["outer"] <= whole - watch.seconds["inner"]
