"""Exported heads do what their policy does, without it."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch.export import ExportedProgram

from pipeline.base.config import ExportParams, TrainHeadParams
from pipeline.base.errors import ConfigError, NumericsError
from pipeline.base.projection import Basis
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.normalization import ChannelStatistics, Normalization
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Policy
from pipeline.policy.shape import Anchor, SlotPlace
from pipeline.robot import export
from pipeline.robot.export import Head, export_head, onnx_runner, random_inputs, torch_runner

GROUPS = ("translation", "translation", "rotation")
SHAPE = PolicyShape(
    3, 8, 5, 5, 3, GROUPS, views=2, state_kinds=("plain", "deg", "rotation", "rotation", "rotation")
)
STREAMS = {
    "action": {"names": ["dx", "dy", "da"], "units": ["mm", "mm", "deg"], "kind": "delta"},
    "sensor": {"names": [f"s{index}" for index in range(5)], "units": ["N", "", "", "", ""]},
    "state": {"names": ["x", "j1", "a", "b", "r"], "units": ["mm", "deg", "deg", "deg", "deg"]},
    "views": ["View1", "View2"],
}
SMALL: dict[str, Any] = {
    "sensor_encoder": {"channels": [8], "layers": 1, "heads": 1, "output_dim": 8},
    "state_encoder": {"dim": 8, "layers": 1, "heads": 1, "output_dim": 8},
    "expert": {"dim": 8, "layers": 1, "heads": 2},
    "diffusion": {"timesteps": 6, "sampling_steps": 2},
    "flow_matching": {"sampling_steps": 2},
    "horizon": 4,
    "sensor_window": 6,
    "state_window": 5,
}
FLOW: dict[str, Any] = {
    "model_type": "flow_matching",
    "fusion_strategy": "gated",
    "flow_matching": {"sampling_steps": 1},
    "sensor_encoder": SMALL["sensor_encoder"] | {"layers": 0},
    "state_encoder": SMALL["state_encoder"] | {"layers": 0},
}
"""Few operators: what exporting takes goes with their number."""
FEATURES_ALONE: dict[str, Any] = {
    "sensor_enabled": False,
    "robot_state_enabled": False,
    "model_type": "diffusion",
    "diffusion": {"timesteps": 6, "sampling_steps": 2, "eta": 1.0},
    "feature_encoder": {"kind": "pooler", "queries": 2, "dim": 4, "heads": 1},
    "feature_history": 2,
}
RARE: list[dict[str, Any]] = [
    {
        "fusion_strategy": "none",
        "sensor_encoder": SMALL["sensor_encoder"] | {"kind": "force_aware"},
        "sensor_window_s": None,
        "state_window_s": None,
    },
    {
        "features_enabled": False,
        "model_type": "flow_matching",
        "flow_matching": {"sampling_steps": 2, "solver": "rk4"},
    },
    {"sensor_enabled": False, "fusion_strategy": "cross_attention"},
    {"robot_state_enabled": False, "fusion_strategy": "gated"},
    {"model_type": "diffusion", "diffusion": {"timesteps": 6, "sampler": "ddpm"}},
    {"model_type": "regression", "fusion_strategy": "concat"},
]


def checkpoint_of(**changed: Any) -> PolicyCheckpoint:
    """Of a policy whose every weight is heard; that of `FLOW` counts from states."""
    params = TrainHeadParams.model_validate(SMALL | changed)
    views = [SlotPlace("tokens", view, (0.5, 0.5)) for view in STREAMS["views"]]
    places = (SlotPlace("mean"), *views)
    shape = replace(SHAPE, places=places, history=params.feature_history)
    if changed == FLOW:
        shape = replace(shape, anchors=(Anchor((0,), (0,)),), relative=(Anchor((1,), (1,)),))
    rng = np.random.default_rng(0)
    fitted = {
        name: ChannelStatistics(rng.normal(size=size), rng.uniform(0.5, 2.0, size), 100)
        for name, size in SHAPE.channels.items()
    }
    normalization = Normalization(**fitted, relative=fitted["action"] if shape.relative else None)
    torch.manual_seed(1)
    state = Policy(params, shape, normalization).state_dict()
    kept = ("schedule",)
    weights = {
        name: value if name.split(".")[1] in kept else value + 0.1 * torch.randn(value.shape)
        for name, value in state.items()
    }
    source = {
        "feature_spec": {"digest": "tiny-spec"},
        "streams": STREAMS,
        "action_hz": 10.0,
        "vlm_reuse_count": 3,
    }
    return PolicyCheckpoint(params, shape, normalization, source, {}, 7, weights)


def exported(
    folder: Path, checkpoint: PolicyCheckpoint, *formats: str, **changed: Any
) -> dict[str, Any]:
    params = ExportParams.model_validate({"output": folder, "formats": formats} | changed)
    return export_head(checkpoint, "models/head", params, lambda said: None)


HAS_ONNX = all(map(find_spec, ("onnx", "onnxscript", "onnxruntime")))


class Exported(NamedTuple):
    """A checkpoint, the folder of its exported head, and the receipt."""

    checkpoint: PolicyCheckpoint
    folder: Path
    receipt: dict[str, Any]


Export = Callable[[dict[str, Any]], Exported]


@pytest.fixture(scope="module")
def export_of(tmp_path_factory: pytest.TempPathFactory) -> Export:
    """`export_of(kind)`: its export in every format that can be written here, once a kind.

    Of `FEATURES_ALONE` not in ONNX, which takes seconds.
    """
    done: dict[str, Exported] = {}

    def export_once(kind: dict[str, Any]) -> Exported:
        if str(kind) not in done:
            folder, checkpoint = tmp_path_factory.mktemp("export") / "head", checkpoint_of(**kind)
            formats = [*["onnx"] * (HAS_ONNX and kind != FEATURES_ALONE), "torch"]
            receipt = exported(folder, checkpoint, *formats)
            done[str(kind)] = Exported(checkpoint, folder, receipt)
        return done[str(kind)]

    return export_once


@pytest.fixture
def traced_once(monkeypatch: pytest.MonkeyPatch, traced: ExportedProgram) -> None:
    """Tracing, which takes seconds, gives what was traced before."""
    monkeypatch.setattr(export, "trace", lambda head, given: traced)


@pytest.fixture(scope="module")
def traced(export_of: Export) -> ExportedProgram:
    """The graph of `checkpoint_of(**FEATURES_ALONE)`."""
    return torch.export.load(export_of(FEATURES_ALONE).folder / "head.pt2")


def assert_same(run: export.Runner, checkpoint: PolicyCheckpoint, atol: float) -> None:
    """For every batch the file does what the policy does, on other inputs than it was judged on."""
    policy = checkpoint.policy()
    for rows in (1, 3, 16):
        given = random_inputs(checkpoint, policy, rows, seed=rows)
        expected = Head(policy)(**given)
        assert expected.std() > 0.01
        found = torch.from_numpy(run(given))
        torch.testing.assert_close(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize(
    "kind",
    [
        FLOW,
        FEATURES_ALONE,
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in RARE),
    ],
    ids=str,
)
def test_every_format_is_the_policy(kind: dict[str, Any], export_of) -> None:
    """ONNX only where its packages are installed."""
    done = export_of(kind)
    assert done.receipt["files"]["head.pt2"]["deviation"]["random"]["std"] < 1e-5
    assert_same(torch_runner(done.folder / "head.pt2"), done.checkpoint, 1e-5)
    if "head.onnx" in done.receipt["files"]:
        assert done.receipt["files"]["head.onnx"]["deviation"]["random"]["std"] < 2e-5
        assert_same(onnx_runner(done.folder / "head.onnx"), done.checkpoint, 2e-5)


def test_the_receipt_says_what_goes_in_and_comes_out(export_of) -> None:
    _, folder, receipt = export_of(FLOW)
    assert json.loads((folder / "receipt.json").read_text()) == receipt
    inputs = {one["name"]: one for one in receipt["inputs"]}
    assert list(inputs) == [
        "features", "slot_valid", "feature_age", "view_age", "sensor", "sensor_valid",
        "sensor_age", "state", "state_valid", "state_age", "noise",
    ]  # fmt: skip
    assert inputs["sensor"]["shape"] == ["batch", 6, 5]
    assert inputs["sensor"]["units"] == STREAMS["sensor"]["units"]
    assert inputs["view_age"]["channels"] == ["View1", "View2"]
    assert inputs["slot_valid"]["dtype"] == "bool"
    assert inputs["noise"]["shape"] == ["batch", 1, 4, 3]
    (action,) = receipt["outputs"]
    assert (action["shape"], action["units"]) == (["batch", 4, 3], ["mm", "mm", "deg"])
    assert receipt["feature_spec_digest"] == "tiny-spec"
    assert (receipt["action_hz"], receipt["horizon"]) == (10.0, 4)
    assert "rtc" in receipt["guides"]
    file = receipt["files"]["head.pt2"]
    assert file["sha256"] == sha256((folder / "head.pt2").read_bytes()).hexdigest()


LOADED = """
import sys
sys.modules["pipeline"] = None  # whoever imports it now fails
import torch
given = torch.load("given.pt", weights_only=True)
torch.save(torch.export.load("head/head.pt2").module()(**given), "actions.pt")
"""


def test_a_process_without_this_project_runs_it(export_of, tmp_path) -> None:
    checkpoint, folder, _ = export_of(FEATURES_ALONE)
    (tmp_path / "head").symlink_to(folder)
    policy = checkpoint.policy()
    given = random_inputs(checkpoint, policy, 2)
    torch.save(given, tmp_path / "given.pt")
    bare = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([sys.executable, "-c", LOADED], cwd=tmp_path, env=bare, check=True)
    found = torch.load(tmp_path / "actions.pt", weights_only=True)
    torch.testing.assert_close(found, Head(policy)(**given), rtol=0, atol=1e-6)


@pytest.mark.extra
@pytest.mark.skipif(not HAS_ONNX, reason="no ONNX: pip install -e '.[export]'")
def test_an_onnx_file_says_what_it_is_and_not_where_it_was_made(export_of) -> None:
    _, folder, receipt = export_of(FLOW)
    told = export.onnx_session(folder / "head.onnx").get_modelmeta().custom_metadata_map
    contract = {name: value for name, value in receipt.items() if name != "files"}
    assert json.loads(told["contract.json"]) == contract
    assert str(Path(__file__).parents[2]).encode() not in (folder / "head.onnx").read_bytes()


@pytest.mark.usefixtures("traced_once")
def test_a_file_that_is_off_is_refused_and_the_old_one_stays(tmp_path, monkeypatch) -> None:
    folder, checkpoint = tmp_path / "head", checkpoint_of(**FEATURES_ALONE)
    exported(folder, checkpoint, "torch")
    before = (folder / "head.pt2").read_bytes()
    honest = torch_runner

    def off(path: Path) -> export.Runner:
        run = honest(path)
        return lambda given: run(given) + np.float32(0.01)

    monkeypatch.setattr(export, "torch_runner", off)
    with pytest.raises(
        NumericsError, match=r"at most 0.0001 training std.*found 0.0084 over random inputs"
    ):
        exported(folder, checkpoint, "torch")
    assert (folder / "head.pt2").read_bytes() == before
    assert not folder.with_name("head.new").exists()


def test_somebody_elses_folder_is_left_alone(tmp_path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="an exported head that this project wrote"):
        exported(tmp_path, checkpoint_of(**FEATURES_ALONE), "torch")
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.usefixtures("traced_once")
def test_golden_rows_are_judged_too(tmp_path) -> None:
    checkpoint, rng = checkpoint_of(**FEATURES_ALONE), np.random.default_rng(0)
    rows = [
        SimpleNamespace(
            features=rng.normal(size=(3, 8)).astype(np.float32), slot_valid=np.ones(3, bool)
        )
        for _ in range(4)
    ]
    object.__setattr__(checkpoint, "golden", tuple(rows))
    object.__setattr__(checkpoint, "basis", Basis(np.ones((2, 9, 8), np.float32)))
    mean = {"layer": 3, "norm": True, "pooling": "mean"}
    views = [mean | {"pooling": "view_mean", "view": view} for view in STREAMS["views"]]
    checkpoint.source["feature_spec"]["slots"] = [mean, *views]
    receipt = exported(tmp_path / "head", checkpoint, "torch")
    assert receipt["features_on"].endswith("groups of 1, 2 slots, in order")
    (file,) = receipt["files"].values()
    assert list(file["deviation"]) == ["random", "golden"]
    assert np.load(tmp_path / "head" / "basis.npy").shape == (2, 9, 8)
    unread = export.describe(checkpoint, "head", {})
    assert unread["features_on"] == "the model's channels", "without the input, no basis either"
    rows[0].features[0, 0] = np.nan
    with pytest.raises(NumericsError, match="found nan over golden inputs"):
        exported(tmp_path / "head", checkpoint, "torch")
