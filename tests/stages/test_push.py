"""A policy and a store reach a server that speaks the Hub's API, each with its card."""

import base64
import json
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from huggingface_hub import HfApi

from pipeline.base.config import load_params
from pipeline.base.errors import ConfigError, HubError, StoreMismatch
from pipeline.look.hub import push, store_card
from pipeline.store import FeatureStore
from stages import evaluate, rollout
from stages.command import run

COMMIT = "https://huggingface.co/lab/needle/commit/1"


class Hub(ThreadingHTTPServer):
    """Keeps what is committed; `full` refuses every commit."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answering)
        self.repos: dict[str, dict[str, bytes]] = {}
        self.made: list[dict[str, Any]] = []
        self.full = self.public = False

    @property
    def api(self) -> HfApi:
        return HfApi(endpoint=f"http://127.0.0.1:{self.server_address[1]}", token="hf_test")


class Answering(BaseHTTPRequestHandler):
    server: Hub

    def do_GET(self) -> None:
        name = "/".join(self.path.split("/")[3:5])
        self.answer({"id": name, "private": not self.server.public, "siblings": []})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        place = self.path.split("/")
        if self.path == "/api/repos/create":
            self.server.made.append(json.loads(body))
            self.answer({"url": f"https://huggingface.co/lab/{self.server.made[-1]['name']}"})
        elif self.path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif place[5] == "preupload":
            files = json.loads(body)["files"]
            modes = [{"path": f["path"], "uploadMode": "regular"} for f in files]
            self.answer({"files": [{**mode, "shouldIgnore": False} for mode in modes]})
        elif self.server.full:
            self.answer({"error": "the storage is full"}, 403)
        else:
            lines = [json.loads(line)["value"] for line in body.decode().splitlines()]
            files = {line["path"]: base64.b64decode(line["content"]) for line in lines[1:]}
            self.server.repos["/".join(place[2:5])] = files
            self.answer({"commitUrl": COMMIT, "commitOid": "1", "pullRequestUrl": None})

    def answer(self, document: dict[str, Any], status: int = 200) -> None:
        body = json.dumps(document).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub() as server:
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


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
    push(load_params(trained, set_), hub.api, said.append)
    assert "No evaluation or rollout of these weights" in card_of(hub, "models/lab/needle")
    for stage in (evaluate, rollout):
        given = [part for value in set_ for part in ("--set", value)]
        assert run("", stage.main, ["--params", str(trained), *given]) == 0
    push(load_params(trained, set_), hub.api, said.append)
    card = card_of(hub, "models/lab/needle")
    assert "pipeline_tag: robotics" in card and "| demonstrator |" not in card
    assert "| expert | 100%" in card and "| chunk | overall |" in card
    made = hub.made[0]  # Releases of huggingface_hub differ in how they say it.
    assert made["name"] == "needle" and (made.get("private") or made["visibility"] == "private")
    names = hub.repos["models/lab/needle"].keys()
    assert {"README.md", "policy.json", "policy.safetensors", "golden.safetensors"} == names
    assert said[-1] == COMMIT


def test_a_store_comes_back_as_it_was(trained: Path, hub: Hub, tmp_path: Path) -> None:
    store = load_params(trained).extract.store
    wanted = [f"push.folder={store}", "push.repo=lab/store", "push.private=false"]
    push(load_params(trained, wanted), hub.api, lambda line: None)
    assert "datasets/lab/store" in hub.repos and "| episodes | 2 |" in card_of(
        hub, "datasets/lab/store"
    )
    for name, content in hub.repos["datasets/lab/store"].items():
        (tmp_path / "back" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "back" / name).write_bytes(content)
    assert FeatureStore.open(tmp_path / "back").spec == FeatureStore.open(store).spec


def test_a_stream_that_is_not_there_is_said_to_be_none(tiny_store, tmp_path):
    card = store_card(FeatureStore.open(tiny_store(tmp_path, sensor_channels=0)), "lab/store")
    assert "| sensor | none |" in card and "| state | joint_0, joint_1" in card


def test_the_card_alone_uploads_nothing(trained: Path, hub: Hub) -> None:
    said: list[str] = []
    wanted = load_params(trained, ["push.repo=lab/needle", "push.card_only=true"])
    push(wanted, hub.api, said.append)
    assert "## What it needs" in said[0] and any("policy.safetensors" in line for line in said)
    assert hub.made == [] and hub.repos == {}


def test_what_the_hub_refuses_and_what_cannot_be_pushed(trained, hub, tmp_path):
    hub.public = True
    with pytest.raises(HubError, match="is there and public"):
        push(load_params(trained, ["push.repo=lab/needle"]), hub.api)
    assert hub.repos == {}
    hub.public, hub.full = False, True
    with pytest.raises(HubError, match="lab/needle"):
        push(load_params(trained, ["push.repo=lab/needle"]), hub.api)
    with pytest.raises(ConfigError, match="owner/name"):
        push(load_params(trained, ["push.repo=needle"]), hub.api)
    with pytest.raises(StoreMismatch, match=r"push\.folder"):
        push(load_params(trained, ["push.repo=a/b", f"push.folder={tmp_path}"]), hub.api)


def card_of(hub: Hub, repo: str) -> str:
    return hub.repos[repo]["README.md"].decode()
