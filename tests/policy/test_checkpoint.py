"""A checkpoint comes back whole, or says what is wrong with it."""

import json
from dataclasses import replace
from functools import reduce
from operator import getitem

import numpy as np
import pytest
import torch

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch
from pipeline.base.files import read_document, read_tensors, write_tensors, write_with_digest
from pipeline.base.provenance import SplitPart
from pipeline.policy.checkpoint import (
    PolicyCheckpoint,
    check_policy,
    find_policy,
    load_policy,
    save_policy,
)
from pipeline.policy.policy import Policy
from pipeline.policy.shape import Anchor
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.run import policy_shape
from pipeline.train.statistics import fit_normalization
from pipeline.train.training_data import source_of

WINDOWS = Windows(8, 65, 100, 0.1, 1.0)
CHOSEN = {"horizon": 3, "group_weights": {"rotation": 2.0}, "store": "some/where.zarr"}


@pytest.fixture(scope="module")
def store(tiny_store, tmp_path_factory):
    return FeatureStore.open(tiny_store(tmp_path_factory.mktemp("checkpoint")))


def part(first: int, stop: int, content: str, group: str) -> SplitPart:
    return SplitPart(ticks=(first, stop), content=content, group=group)


@pytest.fixture
def checkpoint(store, tiny_head, tmp_path):
    params = TrainHeadParams.model_validate(tiny_head(tmp_path, **CHOSEN))
    normalization = fit_normalization(store, torch.arange(60).numpy(), WINDOWS)
    shape = policy_shape(store, normalization)
    torch.manual_seed(3)
    return PolicyCheckpoint(
        params=params,
        shape=shape,
        normalization=normalization,
        source=source_of(store),
        split={
            "train": {"right/episode_005": part(0, 20, "0-5", "right/episode_005")},
            "val": {"right/episode_005": part(24, 30, "0-5", "right/episode_005")},
            "test": {"left/episode_004": part(0, 30, "0-4", "elsewhere")},
        },
        step=7,
        weights=Policy(params, shape, normalization).state_dict(),
        metrics={"val/error": 1 / 3},
    )


def test_a_checkpoint_comes_back_to_the_bit(checkpoint, store, tmp_path):
    save_policy(tmp_path / "best", checkpoint)
    found = load_policy(tmp_path / "best")
    assert found.params == checkpoint.params
    assert found.shape == checkpoint.shape
    assert found.source == checkpoint.source
    assert found.split == checkpoint.split
    assert (found.step, found.metrics, found.golden) == (7, {"val/error": 1 / 3}, ())
    assert not (tmp_path / "best/golden.safetensors").exists()
    for name, value in checkpoint.weights.items():
        assert torch.equal(found.weights[name], value), name
    batch = store.gather([0, 31], horizon=3, sensor_window=6, state_window=5)
    assert torch.equal(found.policy().act(batch), checkpoint.policy().act(batch))


def test_its_description_is_what_serving_needs(checkpoint, tmp_path):
    save_policy(tmp_path / "best", checkpoint)
    path = tmp_path / "best/policy.json"
    document = json.loads(path.read_text())
    assert document["feature_spec"]["digest"] == "tiny-spec"
    assert document["streams"]["action"]["units"] == ["mm", "mm", "mm", "deg", ""]
    assert document["action_hz"] == 10.0
    assert document["vlm_reuse_count"] == 3
    assert document["params"]["train_head"]["horizon"] == 3
    left = {"ticks": [0, 30], "content": "0-4", "group": "elsewhere"}
    assert document["split"]["test"] == {"left/episode_004": left}
    assert document["normalization"]["action"]["count"] == 60
    document["split"]["test"]["left/episode_004"]["ticks"] = [20, 30]
    path.write_text(json.dumps(document))
    with pytest.raises(CheckpointIncomplete, match=r"policy\.json: it was altered"):
        load_policy(tmp_path / "best")


def test_keys_of_other_versions_are_left_out(checkpoint, tmp_path):
    save_policy(tmp_path / "best", checkpoint)
    path = tmp_path / "best/policy.json"
    document = read_document(path, dict)[1]
    head = document["params"]["train_head"]
    head |= {"sensor_lr": 1e-3, "loggers": ["report"], "regression": {"refinements": 1}}
    head["diffusion"]["schedule"] = "cosine"
    write_with_digest(path, document)
    assert load_policy(tmp_path / "best").params == checkpoint.params


def test_a_folder_or_a_run_is_found(checkpoint, tmp_path):
    save_policy(tmp_path / "head" / "best", checkpoint)
    assert find_policy(tmp_path / "head") == tmp_path / "head/best"
    assert find_policy(tmp_path / "head/best") == tmp_path / "head/best"
    (tmp_path / "other.part").mkdir()
    with pytest.raises(CheckpointIncomplete, match=r"unfinished training in .*other\.part"):
        find_policy(tmp_path / "other")


OVERLAPPING = part(10, 24, "0-5", "g").model_dump(mode="json")


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("format", 2, "format: expected 3, found 2"),
        ("shape.action_groups", ["other"], "shape.action_groups: expected 5, found 1"),
        ("streams.views", ["View2"], "feature_spec.views: expected ('View2',), found ('View1',)"),
        ("split", {"train": {}}, "split: expected train, val, test, found train"),
        ("split.train.right/episode_005.ticks", [9, 3], "expected the first before the last"),
        ("split.test.left/b", OVERLAPPING, "found some of '0-5' in both train and test"),
        ("normalization.state", None, "state: expected mean and std of (4,), found None"),
        ("normalization.action.mean", [0.0], "action: expected mean and std of (5,), found ((1,)"),
        ("params.train_head.expert.heads", 7, "heads must divide the width"),
    ],
)
def test_a_description_that_is_none_is_named(checkpoint, tmp_path, place, value, said):
    save_policy(tmp_path / "best", checkpoint)
    path = tmp_path / "best/policy.json"
    document = read_document(path, dict)[1]
    *above, key = place.split(".")
    reduce(getitem, above, document)[key] = value
    write_with_digest(path, document)
    with pytest.raises(CheckpointIncomplete) as caught:
        load_policy(tmp_path / "best")
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and said in message
    assert "Copy it again, name another, or remove its folder and run the training" in message


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda values: values.half(), r'"torch.float16", .* -> \["torch.float32"'),
        (lambda values: values * torch.nan, "expected finite numbers, found NaN"),
        (lambda values: None, r'null -> \["torch.float32"'),
    ],
    ids=["float16", "nan", "missing"],
)
def test_weights_of_another_policy_are_refused(checkpoint, tmp_path, change, said):
    name = next(name for name, value in checkpoint.weights.items() if value.ndim == 2)
    weights = {**checkpoint.weights, name: change(checkpoint.weights[name])}
    weights = {name: value for name, value in weights.items() if value is not None}
    save_policy(tmp_path / "best", replace(checkpoint, weights=weights))
    with pytest.raises((CheckpointIncomplete, CheckpointMismatch), match=said) as caught:
        load_policy(tmp_path / "best")
    assert str(tmp_path / "best/policy.safetensors") in str(caught.value)


class TestGoldenRows:
    @pytest.fixture
    def golden(self, checkpoint, tiny_golden, tmp_path):
        store = FeatureStore.open(tiny_golden(tmp_path, name="golden"))
        return replace(checkpoint, source=source_of(store), golden=store.golden)

    def test_they_come_back_to_the_bit(self, golden, tmp_path):
        save_policy(tmp_path / "best", golden)
        loaded = load_policy(tmp_path / "best").golden
        assert len(loaded) == 2
        for before, after in zip(golden.golden, loaded, strict=True):
            assert (before.key, before.prompt) == (after.key, after.prompt)
            assert before.instruction == after.instruction
            assert np.array_equal(before.features, after.features)
            assert np.array_equal(before.slot_valid, after.slot_valid)
            assert {*before.frames} == {*after.frames} == {"View1"}
            assert np.array_equal(before.frames["View1"], after.frames["View1"])
            assert after.frames["View1"].dtype == np.uint8

    def test_damage_is_named(self, golden, tmp_path):
        save_policy(tmp_path / "best", golden)
        path = tmp_path / "best/golden.safetensors"
        content = bytearray(path.read_bytes())
        content[-1] ^= 1
        path.write_bytes(content)
        for read in (load_policy, check_policy):
            with pytest.raises(CheckpointIncomplete, match=r"golden\.safetensors: .*Copy it again"):
                read(tmp_path / "best")

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("0/frames/View1", torch.zeros(6, 8, 3)),
            ("0/frames/View1", torch.zeros(0, 8, 3, dtype=torch.uint8)),
            ("0/frames/View9", torch.zeros(6, 8, 3, dtype=torch.uint8)),
        ],
    )
    def test_what_is_no_row_of_this_policy_is_named(self, golden, tmp_path, name, value):
        save_policy(tmp_path / "best", golden)
        path = tmp_path / "best/golden.safetensors"
        document = read_document(tmp_path / "best/policy.json", dict)[1]
        tensors = read_tensors(path, document["golden"]["sha256"])
        document["golden"]["sha256"] = write_tensors(path, {**tensors, name: value})
        write_with_digest(tmp_path / "best/policy.json", document)
        with pytest.raises(CheckpointMismatch, match=rf"golden\.safetensors does not fit.*{name}"):
            load_policy(tmp_path / "best")


def test_anchors_travel(checkpoint, tmp_path):
    shape = replace(checkpoint.shape, anchors=(Anchor((0,), (1,)),))
    save_policy(tmp_path / "policy", replace(checkpoint, shape=shape))
    assert load_policy(tmp_path / "policy").shape == shape
    shape = replace(shape, anchors=(Anchor((0,), (12,)),))
    save_policy(tmp_path / "wrong", replace(checkpoint, shape=shape))
    with pytest.raises(CheckpointIncomplete, match=r"policy\.json: .*shape\.anchors: expected"):
        load_policy(tmp_path / "wrong")
