"""A policy and a store reach the Hub, each with its card."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from huggingface_hub.errors import HfHubHTTPError

from pipeline.base.config import load_params
from pipeline.base.errors import ConfigError, HubError, StoreMismatch
from pipeline.look.hub import push, store_card
from pipeline.store import FeatureStore
from stages import evaluate, rollout
from stages.command import run

COMMIT = "https://huggingface.co/lab/needle/commit/1"
# All that the error asks of a response, whichever client huggingface_hub has.
REFUSED: Any = SimpleNamespace(headers={}, request=None)


class Hub:
    """Stands for `HfApi`: keeps what is committed; `full` refuses every commit."""

    def __init__(self) -> None:
        self.repos: dict[str, dict[str, bytes]] = {}
        self.made: list[tuple[str, bool]] = []
        self.full = self.public = False

    def create_repo(self, repo: str, repo_type: str, private: bool, exist_ok: bool) -> None:
        assert exist_ok
        self.made.append((repo, private))

    def repo_info(self, repo: str, repo_type: str) -> SimpleNamespace:
        return SimpleNamespace(private=not self.public)

    def create_commit(self, repo: str, operations: list[Any], **_: Any) -> SimpleNamespace:
        if self.full:
            raise HfHubHTTPError("the storage is full", response=REFUSED)
        files: dict[str, bytes] = {}
        for operation in operations:
            with operation.as_file() as file:
                files[operation.path_in_repo] = file.read()
        self.repos[repo] = files
        return SimpleNamespace(commit_url=COMMIT)


@pytest.fixture
def hub() -> Any:
    return Hub()


def test_a_judged_policy_is_uploaded_with_its_own_figures(trained, hub, tmp_path, monkeypatch):
    # Pages, whose pictures take most of the time, are not uploaded.
    monkeypatch.setattr("pipeline.look.page.writing.write_report", lambda *_: [])
    set_ = [f"evaluate.output={tmp_path / 'evaluate'}", "evaluate.modalities=false"]
    set_ += [
        f"rollout.output={tmp_path / 'rollout'}",
        "rollout.ablations=[]",
        "push.repo=lab/needle",
    ]
    said: list[str] = []
    push(load_params(trained, set_), hub, said.append)
    assert "No evaluation or rollout of these weights" in card_of(hub, "lab/needle")
    for stage in (evaluate, rollout):
        given = [part for value in set_ for part in ("--set", value)]
        assert run("", stage.main, ["--params", str(trained), *given]) == 0
    push(load_params(trained, set_), hub, said.append)
    card = card_of(hub, "lab/needle")
    assert "pipeline_tag: robotics" in card and "| demonstrator |" not in card
    assert "| expert | 100%" in card and "| chunk | overall |" in card
    assert hub.made[0] == ("lab/needle", True)
    names = hub.repos["lab/needle"].keys()
    assert {"README.md", "policy.json", "policy.safetensors", "golden.safetensors"} == names
    assert said[-1] == COMMIT


def test_a_store_comes_back_as_it_was(trained: Path, hub: Hub, tmp_path: Path) -> None:
    store = load_params(trained).extract.store
    wanted = [f"push.folder={store}", "push.repo=lab/store", "push.private=false"]
    push(load_params(trained, wanted), hub, lambda line: None)
    assert "lab/store" in hub.repos and "| episodes | 2 |" in card_of(hub, "lab/store")
    for name, content in hub.repos["lab/store"].items():
        (tmp_path / "back" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "back" / name).write_bytes(content)
    assert FeatureStore.open(tmp_path / "back").spec == FeatureStore.open(store).spec


def test_a_stream_that_is_not_there_is_said_to_be_none(tiny_store, tmp_path):
    card = store_card(FeatureStore.open(tiny_store(tmp_path, sensor_channels=0)), "lab/store")
    assert "| sensor | none |" in card and "| state | joint_0, joint_1" in card


def test_the_card_alone_uploads_nothing(trained: Path, hub: Hub) -> None:
    said: list[str] = []
    wanted = load_params(trained, ["push.repo=lab/needle", "push.card_only=true"])
    push(wanted, hub, said.append)
    assert "## What it needs" in said[0]
    assert hub.made == [] and hub.repos == {}


def test_what_the_hub_refuses_and_what_cannot_be_pushed(trained, hub, tmp_path):
    hub.public = True
    with pytest.raises(HubError, match="is there and public"):
        push(load_params(trained, ["push.repo=lab/needle"]), hub)
    assert hub.repos == {}
    hub.public, hub.full = False, True
    with pytest.raises(HubError, match="lab/needle"):
        push(load_params(trained, ["push.repo=lab/needle"]), hub)
    with pytest.raises(ConfigError, match="owner/name"):
        push(load_params(trained, ["push.repo=needle"]), hub)
    with pytest.raises(StoreMismatch, match=r"push\.folder"):
        push(load_params(trained, ["push.repo=a/b", f"push.folder={tmp_path}"]), hub)


def card_of(hub: Hub, repo: str) -> str:
    return hub.repos[repo]["README.md"].decode()
