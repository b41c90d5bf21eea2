"""One model, live or cached: the same answer, the arguments it has always had, and it learns."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from torch import Tensor

from pipeline.base.errors import ObservationError
from pipeline.compat.unified import (
    Not_freeze_QwenVLAWithSensor,
    QwenVLAUnified,
    QwenVLAWithSensor,
    QwenVLAWithSensorDiffusion,
)
from pipeline.policy.expert import Guide
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Trainable
from pipeline.vlm.live import live_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM

Make = Callable[..., Any]

VIEWS = ("View1", "View2")
TEXT = ["insert the needle", "stop", "insert the needle", "retract"]
SMALL: dict[str, Any] = {
    "image_resize_height": 56,
    "image_resize_width": 84,
    "views": VIEWS,
    "pooling": ["mean", "view_mean"],
    "sensor_channels": 9,
    "sensor_window": 13,
    "state_window": 25,
    "vlm": {"dtype": "float32"},
    "sensor_encoder": {"channels": [16, 32], "layers": 1, "heads": 2, "output_dim": 24},
    "state_encoder": {"dim": 16, "layers": 1, "heads": 2, "output_dim": 20},
    "expert": {"dim": 32, "layers": 1, "heads": 2, "dropout": 0.0},
}


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture
def build(demo_checkpoint: Path) -> Make:
    """`build(**arguments)`: a small unified model on the demo's checkpoint, from a fixed seed."""

    def make(kind: type[QwenVLAUnified] = QwenVLAUnified, **arguments: Any) -> QwenVLAUnified:
        torch.manual_seed(0)
        return kind(**(SMALL | {"vl_model_name": str(demo_checkpoint)} | arguments)).eval()

    return make


@pytest.fixture(scope="module")
def images() -> list[dict[str, NDArray[np.uint8]]]:
    """Frames of four samples: the third shows what the first does, the last has one view."""
    rng = np.random.default_rng(0)
    frames = [
        {view: rng.integers(0, 255, (60, 90, 3), np.uint8) for view in VIEWS} for _ in range(3)
    ]
    again = {view: frame.copy() for view, frame in frames[0].items()}
    return [frames[0], frames[1], again, {"View2": frames[2]["View2"]}]


@pytest.fixture
def streams() -> dict[str, Tensor]:
    return {"sensor": torch.randn(4, 13, 9), "state": torch.randn(4, 25, 12)}


def _cached(model: QwenVLAUnified, images: list[Any]) -> tuple[Tensor, Tensor]:
    """What stage one stores for these samples."""
    vlm = model.vlm_params
    spec = live_spec(vlm, VIEWS)
    preparer = Preparer(vlm, spec)
    rows = [preparer.prepare(text, frames) for text, frames in zip(TEXT, images, strict=True)]
    return FrozenVLM.load(vlm, spec, "cpu").encode(rows)


def test_live_cached_and_mixed_give_the_same_chunk(build, images, streams):
    model = build(model_type="flow_matching")
    features, slot_valid = _cached(model, images)

    def act(*args: Any, **over: Any) -> Tensor:
        generator = torch.Generator().manual_seed(3)
        return model(*args, **streams, generator=generator, **over)

    cached = act(features=features, slot_valid=slot_valid)
    assert cached.shape == (4, 8, 7)
    assert model.vlm is None, "a model used with cached features reads no checkpoint"
    live = act(images, TEXT)
    assert model.vlm is not None
    torch.testing.assert_close(live, cached, atol=2e-4, rtol=1e-3)

    mixed = features.clone()
    mixed[[0, 3]] = torch.nan
    part = [images[0], None, None, images[3]]
    both = act(part, TEXT, features=mixed, slot_valid=slot_valid)
    torch.testing.assert_close(both, cached, atol=2e-4, rtol=1e-3)
    other = act([images[1], *images[1:]], TEXT)
    assert (other[0] - cached[0]).abs().max() > 1e-3, "the chunk depends on what is seen"


def test_what_is_not_given_is_missing(build: Make, streams: dict[str, Tensor]) -> None:
    model = build()
    observation = model.observe(sensor=streams["sensor"])
    assert not observation.slot_valid.any()
    assert observation.sensor_valid.tolist() == [13] * 4
    assert observation.state_valid.tolist() == [0] * 4
    assert model(sensor=streams["sensor"]).isfinite().all()


def test_a_stream_without_an_encoder_is_ignored(build: Make, streams: dict[str, Tensor]) -> None:
    model = build(model_type="regression", sensor_enabled=False)
    torch.testing.assert_close(model(**streams), model(state=streams["state"]))
    assert model(sensor=torch.randn(3, 2), state=streams["state"]).shape == (4, 8, 7)
    with pytest.raises(ObservationError, match="at least one of features, state, found none"):
        model(sensor=torch.randn(4, 13, 9))


def test_nothing_to_observe_and_misspelt_arguments_are_refused(build, streams):
    model = build()
    for arguments in ({"images": [None, None]}, {"actions": torch.randn(4, 8, 7)}):
        with pytest.raises(ObservationError, match="at least one of features, sensor, state"):
            model(**arguments)
    with pytest.raises(TypeError, match="sensor_vaild"):
        model(**streams, sensor_vaild=torch.ones(4))
    for wrong in ({"horizont": 4}, {"lora_r": 0}, {"expert": None}):
        with pytest.raises(ValidationError, match=next(iter(wrong))):
            build(**wrong)


def test_validity_is_taken_as_a_store_has_it(build: Make, streams: dict[str, Tensor]) -> None:
    to = torch.Tensor.numpy
    model = build(model_type="regression")
    features = torch.randn(4, 3, 128)
    real = torch.tensor([[1, 0, 1], [0, 0, 0], [1, 1, 1], [0, 1, 0]])
    counts = torch.tensor([13, 0, 5, 1])
    expected = model(features=features, slot_valid=real.bool(), sensor_valid=counts, **streams)
    found = model(
        features=features, slot_valid=to(real.byte()), sensor_valid=to(counts.int()), **streams
    )
    assert torch.equal(found, expected)
    assert not torch.equal(found, model(features=features, **streams))
    steps = torch.arange(8).expand(4, -1) < torch.tensor([[8], [3], [1], [5]])
    losses = [
        model(**streams, actions=torch.ones(4, 8, 7), action_valid=given)
        for given in (steps, to(steps.byte()))
    ]
    assert torch.equal(*losses)


def test_a_shape_that_does_not_fit_is_named(build: Make, streams: dict[str, Tensor]) -> None:
    model = build()
    for given, message in (
        ({"features": (4, 3, 100)}, r"features: .*slot 3, dim 128\), found \(4, 3, 100"),
        ({"features": (3, 3, 128)}, r"sensor: .*batch 3, .* found \(4, 13, 9\).* that of features"),
        ({"sensor": (4, 0, 9)}, r"sensor: .*window any, .* found \(4, 0, 9\)"),
        ({"sensor_valid": (4, 13)}, r"sensor_valid: .*\(batch 4\), found \(4, 13\)"),
        ({"state_age": (4, 20)}, r"state_age: .*window 25\), found \(4, 20\)"),
        ({"actions": (4, 9, 7)}, r"actions: .*horizon 8, channel 7\), found \(4, 9, 7\)"),
        ({"actions": (4, 8, 7), "action_valid": (4, 7)}, r"action_valid: .*found \(4, 7\)"),
        ({"slot_valid": (4, 3)}, "slot_valid: expected features beside it"),
    ):
        with pytest.raises(ObservationError, match=message):
            model(**(streams | {name: torch.ones(size) for name, size in given.items()}))


def test_images_text_and_streams_are_of_one_batch(build, images, streams):
    model = build()
    for text in (None, TEXT[:3], "stop"):
        with pytest.raises(ObservationError, match="text: expected 4 instructions"):
            model(images, text, **streams)
    for some in (images[:3], [None] * 3):
        with pytest.raises(ObservationError, match=r"images: .*\(batch 4\), found \(3,\)"):
            model(some, TEXT[:3], **streams)


def test_it_is_trainable_and_gives_the_loss_where_actions_are_given(build, images, streams):
    model = build(model_type="diffusion")
    assert isinstance(model, Trainable)
    assert model.stochastic
    assert not build(model_type="regression").stochastic
    observation = model.observe(images, TEXT, **streams)
    assert model.sample(observation, 5).shape == (5, 4, 8, 7)
    guide = Guide(torch.ones(4, 8, 7), torch.ones(4, 8))
    free, guided = (model.act(observation, _generator(), given) for given in (None, guide))
    assert (guided - 1).square().mean() < 0.5 * (free - 1).square().mean()
    actions = torch.randn(4, 8, 7)
    found = model(images, TEXT, **streams, actions=actions, generator=_generator())
    valid = torch.ones(4, 8, dtype=torch.bool)
    assert torch.equal(found, model.loss(observation, actions, valid, _generator())[0])
    masked = model(
        images, TEXT, **streams, actions=actions, action_valid=~valid, generator=_generator()
    )
    assert masked == 0
    assert dict(model.parameter_table())["vlm, learning"] == 0
    assert sum(count for _, count in model.parameter_table()) == sum(
        parameter.numel() for parameter in model.parameters()
    )


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(1)


@pytest.mark.parametrize("finetune_vl", ["none", "lora"])
def test_a_state_dict_restores_it_in_a_fresh_model(build, images, finetune_vl):
    """Whether or not the model in front was loaded when it was saved, and when it is restored."""
    saved = build(model_type="regression", finetune_vl=finetune_vl)
    with torch.no_grad():
        for parameter in saved.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    chunk = saved(images, TEXT)
    restored = build(model_type="regression", finetune_vl=finetune_vl)
    restored.load_state_dict(saved.state_dict())
    torch.testing.assert_close(restored(images, TEXT), chunk)
    restored.load_state_dict(saved.state_dict())
    torch.testing.assert_close(restored(images, TEXT), chunk)
    torch.testing.assert_close(pickle.loads(pickle.dumps(restored))(images, TEXT), chunk)
    with pytest.raises(RuntimeError, match=r"policy\.expert"):
        restored.load_state_dict({})


def test_the_arguments_it_has_always_had() -> None:
    model = QwenVLAUnified()
    params, shape = model.policy.params, model.policy.shape
    assert (params.model_type, params.fusion_strategy) == ("flow_matching", "concat")
    assert (params.horizon, params.sensor_window) == (8, 65)
    sensor, state, expert = params.sensor_encoder, params.state_encoder, params.expert
    assert sensor.channels == (512, 1024, 1024, 1024)
    assert (sensor.layers, sensor.heads, sensor.output_dim) == (2, 8, 1024)
    assert (state.dim, state.layers, state.heads, state.output_dim) == (256, 2, 8, 512)
    assert (expert.dim, expert.layers, expert.heads) == (512, 4, 8)
    assert params.diffusion.timesteps == 100
    assert params.diffusion.prediction == "epsilon"
    assert shape == PolicyShape(
        1, 2048, 1026, 12, 7, ("translation",) * 3 + ("rotation",) * 3 + ("gripper",), views=5
    )
    tuning, vlm = model.tuning, model.vlm_params
    assert (tuning.method, tuning.lora_r, tuning.lora_alpha) == ("none", 16, 32)
    assert tuning.lora_dropout == 0.05
    assert vlm.checkpoint == "Qwen/Qwen2.5-VL-3B-Instruct"
    assert (vlm.image_resize_height, vlm.image_resize_width) == (360, 640)
    chunk = model.eval()(features=torch.randn(2, 1, 2048), sensor=torch.randn(2, 650, 1026))
    assert chunk.shape == (2, 8, 7)


@pytest.mark.parametrize(
    ("alias", "model_type", "finetune_vl"),
    [
        (QwenVLAWithSensorDiffusion, "diffusion", "none"),
        (QwenVLAWithSensor, "regression", "none"),
        (Not_freeze_QwenVLAWithSensor, "regression", "full"),
    ],
)
def test_aliases_build_the_right_thing(build, alias, model_type, finetune_vl):
    model = build(alias, horizon=4)
    assert (model.policy.params.model_type, model.tuning.method) == (model_type, finetune_vl)
    assert model(sensor=torch.randn(1, 13, 9)).shape == (1, 4, 7)
    learns = any(parameter.requires_grad for parameter in model.load_vlm().parameters())
    assert learns == (finetune_vl == "full")
