"""What the doctor says of packages, GPU, checkpoint and recordings."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError
from pipeline.look import doctor
from pipeline.look.doctor import (
    check_checkpoint,
    check_fit,
    check_gpu,
    check_packages,
    check_recordings,
    check_required,
    examine,
    missing,
)
from pipeline.simulation.demo_recordings import MARKER
from pipeline.simulation.insertion_formats import write_lerobot, write_raw
from pipeline.simulation.recorder import simulate_episode


def given(**sections: Any) -> Params:
    document = {
        "data": {"sources": [{"name": "a", "path": "."}]},
        "vlm": {"checkpoint": "a/b"},
        "extract": {"device": "cpu"},
        "train_head": {"device": "cpu"},
    }
    return Params.model_validate(document | sections)


def test_the_projects_own_ranges_hold_here_and_a_logger_is_asked_for_by_name() -> None:
    good, *_ = issues = list(check_packages(given(train_head={"loggers": ["wandb"]})))
    assert good.severity == "ok"
    assert re.search(r"(\d+) of \d+ .*python 3\.\d+.*, torch \d+\.\d+", good.message)
    assert "tensorboard" not in {issue.kind for issue in issues}


def test_a_missing_package_and_an_old_one_are_named_with_what_installs_them() -> None:
    versions = {"torch": "2.13.0+cpu", "zarr": "2.18.0", "python": "3.10.4"}
    lines = ["python>=3.11", "torch>=2.6", "zarr<4,>=3.1.6", "av>=15"]
    good, python, zarr, av = check_required(lines, versions.get)
    assert good.severity == "ok" and "1 of 4" in good.message
    assert (zarr.severity, zarr.message) == ("error", "expected zarr<4,>=3.1.6, found 2.18.0")
    assert zarr.remedy == "pip install 'zarr<4,>=3.1.6'"
    assert av.message == "expected av>=15, found none"
    assert "environment" in python.remedy


def test_a_check_that_fails_is_an_issue(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(params: Params) -> Any:
        raise ConfigError("device: cuda:7")

    groups = {"A": fail, "B": lambda params: [missing("it", "is not there", "get it")]}
    monkeypatch.setattr(doctor, "GROUPS", groups)
    said = [(title, issue.severity, issue.message) for title, (issue,) in examine(given())]
    assert said == [
        ("A", "error", "cannot be looked at: device: cuda:7"),
        ("B", "error", "is not there"),
    ]


def test_a_device_that_torch_cannot_use_is_needed_where_it_is_named() -> None:
    lacking = [i for i in check_gpu(given(extract={"device": "cuda:77"})) if i.severity == "error"]
    assert [issue.kind for issue in lacking] == ["extract.device"]


@pytest.mark.parametrize(("count", "severity"), [(10**9, "ok"), (10**10, "note")])
def test_what_fits_into_memory(monkeypatch, count: int, severity: str) -> None:
    monkeypatch.setattr(doctor, "available_bytes", lambda: 8 * 2**30)
    issue = check_fit(count, given(vlm={"checkpoint": "a/b", "dtype": "bfloat16"}))
    assert issue.severity == severity


class TestCheckpoint:
    @pytest.fixture
    def check(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., list[Any]]:
        """`check(checkpoint, key=value…)` with an empty cache of the hub."""
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
        monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)

        def issues(checkpoint: str | Path, **vlm: object) -> list[Any]:
            own = {"checkpoint": str(checkpoint), "dtype": "float32", **vlm}
            demo = {"checkpoint": str(tmp_path / "demo_vlm")}
            return list(check_checkpoint(given(vlm=own, demo=demo)))

        return issues

    def test_a_whole_folder_and_random_weights(self, check, demo_checkpoint, tmp_path):
        here, fits = check(demo_checkpoint)
        assert (here.severity, fits.severity) == ("ok", "ok")
        assert "whole, 2,519,424 parameters" in here.message
        mine = shutil.copytree(demo_checkpoint, tmp_path / "mine")
        (mine / MARKER).write_text('{"seed": 0}')
        here, _ = check(mine)
        assert here.severity == "note" and "random weights" in here.message

    def test_a_file_that_is_cut_off(self, check, demo_checkpoint, tmp_path):
        broken = shutil.copytree(demo_checkpoint, tmp_path / "broken")
        weights = next(broken.glob("*.safetensors"))
        weights.write_bytes(weights.read_bytes()[:-1])
        (issue,) = check(broken)
        assert issue.severity == "error" and str(weights) in issue.message

    def test_what_is_not_here(self, check, tmp_path):
        (folder,) = check("/no/such/folder")
        assert folder.severity == "error" and "no hub id" in folder.message
        (fetched,) = check("Qwen/Qwen2.5-VL-3B-Instruct")
        assert fetched.severity == "note"
        assert fetched.remedy == "hf download Qwen/Qwen2.5-VL-3B-Instruct"
        (demo,) = check(tmp_path / "demo_vlm")
        assert demo.severity == "error" and "stages.demo" in demo.remedy


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two simulated episodes as the recorder writes them, and one as LeRobot does."""
    root = tmp_path_factory.mktemp("machine")
    episodes = [simulate_episode(seed, 1.7e9 + 60 * seed) for seed in range(2)]
    for episode in episodes:
        write_raw(root / "raw", episode)
    write_lerobot(root / "lerobot", episodes[:1])
    return root


class TestRecordings:
    def check(self, root: Path, *sources: str, **data: Any) -> list[Any]:
        named = [{"name": source, "path": source} for source in sources]
        return list(check_recordings(given(data={"root": str(root), "sources": named, **data})))

    def test_what_is_not_there_is_missing(self, recordings):
        (root,) = self.check(recordings / "nowhere", "a")
        assert root.severity == "error" and str(recordings / "nowhere") in root.message
        (source,) = self.check(recordings, "2025-*")
        assert (source.severity, source.kind) == ("error", "2025-*")

    @pytest.mark.parametrize(("on_bad", "level"), [("stop", "error"), ("skip", "note")])
    def test_a_sensor_file_and_a_video_that_are_cut_off(self, recordings, tmp_path, on_bad, level):
        root = Path(shutil.copytree(recordings, tmp_path / "root"))
        for path in (sorted(root.rglob("sensor_data*.npz"))[-1], next(root.rglob("*.mp4"))):
            path.write_bytes(path.read_bytes()[:-2000])
        _, raw, _, video = self.check(root, "raw", "lerobot", on_bad_episode=on_bad)
        assert (raw.severity, video.severity) == (level, level)
        assert "1 episode(s) cannot be read" in raw.message and "sensor_data" in raw.message
        assert ".mp4" in video.message
