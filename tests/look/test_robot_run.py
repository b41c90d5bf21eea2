"""Which features of a recorded run a store has."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import RecordingError, StoreMismatch
from pipeline.look.robot_run import compare_keys
from pipeline.store import FeatureStore


@pytest.fixture
def store(tiny_store: Callable[..., Path], tmp_path: Path) -> FeatureStore:
    return FeatureStore.open(tiny_store(tmp_path))


def write_run(root: Path, keys: np.ndarray, **spec: object) -> Path:
    (root / "features").mkdir(parents=True)
    np.savez(root / "features" / "episode_000000.npz", key=keys)
    run: dict[str, object] = {"ticks": 9, "rows": 7, "dropped_images": 2, "reason": "time is up"}
    run["metadata"] = {"feature_spec": spec}
    (root / "run.json").write_text(json.dumps(run))
    return root


def test_keys_that_the_robot_did_not_have_are_named(store: FeatureStore, tmp_path: Path) -> None:
    episode = store.episodes[1]
    keys = store.array("vl/key")[episode.vl_rows.start : episode.vl_rows.stop]
    root = write_run(tmp_path / episode.path, np.delete(keys, 2, axis=0), **store.spec)
    said = compare_keys(root, store)
    assert said == "9 of 10 VL rows have a key of the robot's; not: 2 (0.60 s)"
    write_run(tmp_path / "other" / episode.path, keys, **store.spec)
    whole = compare_keys(tmp_path / "other" / episode.path, store)
    assert whole == "10 of 10 VL rows have a key of the robot's"


def test_feature_specs_that_differ_are_told(store: FeatureStore, tmp_path: Path) -> None:
    spec = dict(store.spec) | {"digest": "other", "prompt": "other"}
    root = write_run(tmp_path / store.episodes[0].path, np.zeros((1, 16), np.uint8), **spec)
    said = compare_keys(root, store)
    assert said.startswith("0 of 10") and 'the feature specs differ: prompt: "other"' in said


def test_what_cannot_be_compared_is_refused(store: FeatureStore, tmp_path: Path) -> None:
    root = write_run(tmp_path / "elsewhere", np.zeros((1, 16), np.uint8))
    with pytest.raises(StoreMismatch, match="found 0 of 6 at such a path"):
        compare_keys(root, store)
    with pytest.raises(RecordingError, match="expected a recorded run"):
        compare_keys(tmp_path, store)
