"""A checkpoint comes back whole, or says what is wrong with it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.config import TrainHeadParams
from pipeline.base.durable import read_document, write_document, write_with_digest
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch
from pipeline.base.tuned_on import EpisodePart
from pipeline.policy.checkpoint import (
    PolicyCheckpoint,
    check_policy,
    find_policy,
    load_policy,
    save_policy,
)
from pipeline.policy.policy import Policy
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.run import policy_shape
from pipeline.train.split import source_of
from pipeline.train.statistics import fit_normalization

WINDOWS = Windows(8, 65, 100, 0.1, 1.0)
PARAMS = TrainHeadParams.model_validate(
    {
        "sensor_encoder": {"channels": [8], "layers": 0, "heads": 1, "output_dim": 8},
        "state_encoder": {"dim": 8, "layers": 0, "heads": 1, "output_dim": 8},
        "expert": {"dim": 8, "layers": 1, "heads": 1},
        "horizon": 3,
        "sensor_window": 6,
        "state_window": 5,
        "group_weights": {"rotation": 2.0},
        "store": "some/where.zarr",
    }
)


@pytest.fixture(scope="module")
def store(
    tiny_store: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> FeatureStore:
    return FeatureStore.open(tiny_store(tmp_path_factory.mktemp("checkpoint")))


def part(first: int, stop: int, content: str, group: str) -> EpisodePart:
    return EpisodePart(ticks=(first, stop), content=content, group=group)


@pytest.fixture
def checkpoint(store: FeatureStore) -> PolicyCheckpoint:
    normalization = fit_normalization(store, torch.arange(60).numpy(), WINDOWS)
    shape = policy_shape(store, normalization)
    torch.manual_seed(3)
    return PolicyCheckpoint(
        params=PARAMS,
        shape=shape,
        normalization=normalization,
        source=source_of(store),
        split={
            "train": {"right/episode_005": part(0, 20, "0-5", "right/episode_005")},
            "val": {"right/episode_005": part(24, 30, "0-5", "right/episode_005")},
            "test": {"left/episode_004": part(0, 30, "0-4", "elsewhere")},
        },
        step=7,
        weights=Policy(PARAMS, shape, normalization).state_dict(),
        metrics={"val/error": 1 / 3},
    )


def test_a_checkpoint_comes_back_to_the_bit(
    checkpoint: PolicyCheckpoint, store: FeatureStore, tmp_path: Path
) -> None:
    save_policy(tmp_path / "best", checkpoint)
    found = load_policy(tmp_path / "best")
    assert found.params == PARAMS
    assert found.shape == checkpoint.shape
    assert found.source == checkpoint.source
    assert found.split == checkpoint.split
    assert (found.step, found.metrics) == (7, {"val/error": 1 / 3})
    for name, value in checkpoint.weights.items():
        assert torch.equal(found.weights[name], value), name
    batch = store.gather([0, 31], horizon=3, sensor_window=6, state_window=5)
    assert torch.equal(found.policy().act(batch), checkpoint.policy().act(batch))


def test_its_description_is_what_serving_needs(
    checkpoint: PolicyCheckpoint, tmp_path: Path
) -> None:
    save_policy(tmp_path / "best", checkpoint)
    document = json.loads((tmp_path / "best/policy.json").read_text())
    assert document["feature_spec"]["digest"] == "tiny-spec"
    assert document["streams"]["action"]["units"] == ["mm", "mm", "mm", "deg", ""]
    assert document["action_hz"] == 10.0
    assert document["vlm_reuse_count"] == 3
    assert document["params"]["train_head"]["horizon"] == 3
    left = {"ticks": [0, 30], "content": "0-4", "group": "elsewhere"}
    assert document["split"]["test"] == {"left/episode_004": left}
    assert document["normalization"]["action"]["count"] == 60


def test_the_same_checkpoint_is_the_same_bytes(
    checkpoint: PolicyCheckpoint, tmp_path: Path
) -> None:
    for name in ("one", "two"):
        save_policy(tmp_path / name, checkpoint)
    for file in ("policy.json", "policy.safetensors"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_a_folder_or_a_run_is_found(checkpoint: PolicyCheckpoint, tmp_path: Path) -> None:
    save_policy(tmp_path / "head" / "best", checkpoint)
    assert find_policy(tmp_path / "head") == tmp_path / "head/best"
    assert find_policy(tmp_path / "head/best") == tmp_path / "head/best"
    (tmp_path / "other.part").mkdir()
    with pytest.raises(CheckpointIncomplete, match=r"unfinished training in .*other\.part"):
        find_policy(tmp_path / "other")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": 99}, "expected format 3, found 99"),
        ({"format": 2}, "do not tell what chose them from what reports them. Train it again"),
        ({"shape": None}, "not what a checkpoint's description must be"),
        ({"split": {"train": {"left/a": 3}}}, "not what a checkpoint's description must be"),
        ({"params": {"train_head": {"model_type": "oracle"}}}, "model_type"),
        ({"normalization": {}}, "std and count of `action`"),
    ],
)
def test_a_description_that_is_none_is_named(
    checkpoint: PolicyCheckpoint, tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    save_policy(tmp_path / "best", checkpoint)
    path = tmp_path / "best/policy.json"
    write_with_digest(path, read_document(path) | change)
    with pytest.raises((CheckpointIncomplete, CheckpointMismatch), match=said):
        load_policy(tmp_path / "best")


def _ten_times(document: dict[str, Any]) -> None:
    statistics = document["normalization"]["action"]
    statistics["std"] = [10 * number for number in statistics["std"]]


def _fewer_test_ticks(document: dict[str, Any]) -> None:
    document["split"]["test"]["left/episode_004"]["ticks"] = [20, 30]


@pytest.mark.parametrize("alter", [_ten_times, _fewer_test_ticks])
def test_an_altered_description_is_refused(
    checkpoint: PolicyCheckpoint, tmp_path: Path, alter: Callable[[dict[str, Any]], None]
) -> None:
    save_policy(tmp_path / "best", checkpoint)
    path = tmp_path / "best/policy.json"
    document = json.loads(path.read_text())
    alter(document)
    path.write_text(json.dumps(document))
    with pytest.raises(CheckpointIncomplete, match=r"policy\.json: .*damaged: it was altered"):
        load_policy(tmp_path / "best")


def test_a_description_of_before_digests_is_taken_and_told(
    checkpoint: PolicyCheckpoint, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_policy(tmp_path / "best", checkpoint)
    path = tmp_path / "best/policy.json"
    document = read_document(path)
    document["params"]["train_head"] |= {"scratch": None, "loggers": ["report"]}
    write_document(path, document)
    for _ in range(2):
        assert load_policy(tmp_path / "best").step == checkpoint.step
    (line,) = capsys.readouterr().err.splitlines()
    assert "document_sha256" in line


def test_weights_of_another_policy_are_refused(
    checkpoint: PolicyCheckpoint, tmp_path: Path
) -> None:
    save_policy(tmp_path / "best", checkpoint)
    path = tmp_path / "best/policy.json"
    document = read_document(path)
    document["params"]["train_head"]["expert"]["dim"] = 16
    write_with_digest(path, document)
    with pytest.raises(CheckpointMismatch, match="does not fit the policy"):
        load_policy(tmp_path / "best").policy()


def test_missing_weights_are_named(checkpoint: PolicyCheckpoint, tmp_path: Path) -> None:
    save_policy(tmp_path / "best", checkpoint)
    (tmp_path / "best/policy.safetensors").unlink()
    with pytest.raises(CheckpointIncomplete, match=r"policy\.safetensors.*no such file"):
        load_policy(tmp_path / "best")


class TestGoldenRows:
    @pytest.fixture
    def golden(self, checkpoint, tiny_golden, tmp_path) -> PolicyCheckpoint:
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

    def test_a_checkpoint_without_them_loads(self, checkpoint, tmp_path):
        save_policy(tmp_path / "best", checkpoint)
        assert "golden" not in json.loads((tmp_path / "best/policy.json").read_text())
        assert not (tmp_path / "best/golden.safetensors").exists()
        assert load_policy(tmp_path / "best").golden == ()

    @pytest.mark.parametrize("harm", ["altered", "gone"])
    def test_damage_is_named(self, golden, tmp_path, harm):
        save_policy(tmp_path / "best", golden)
        path = tmp_path / "best/golden.safetensors"
        content = bytearray(path.read_bytes())
        content[-1] ^= 1
        path.unlink()
        if harm == "altered":
            path.write_bytes(content)
        for read in (load_policy, check_policy):
            with pytest.raises(CheckpointIncomplete, match=r"golden\.safetensors: .*damaged"):
                read(tmp_path / "best")
