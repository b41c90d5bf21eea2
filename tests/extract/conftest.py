"""Small recordings in the windowed format, params that extract them, processes that do."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from pipeline.base.config import Params
from pipeline.extract import extract
from pipeline.extract.build_state import StorePlaces
from pipeline.store import FeatureStore, StoreBuild
from pipeline.store.schema import ARRAY_NAMES
from pipeline.vlm.qwen import FrozenVLM


@pytest.fixture(scope="session")
def write_episode() -> Callable[..., Path]:
    """`write_episode(folder, seed, ...)` writes one episode."""
    return _write_episode


def _write_episode(
    folder: Path,
    seed: int = 0,
    seconds: float = 2.0,
    views: tuple[str, ...] = ("View1", "View2"),
    sensor: bool = True,
) -> Path:
    """One episode: cameras at 10 Hz, poses at 100 Hz, a sensor of 1,026 channels at 130 Hz."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    start = 1.7e9 + seed
    for view in views:
        (folder / "images" / view).mkdir(parents=True)
        for frame in range(int(seconds * 10) + 1):
            pixels = rng.integers(0, 255, (24, 32, 3), np.uint8)
            name = f"{start + frame / 10:.3f}.jpg"
            Image.fromarray(pixels).save(folder / "images" / view / name)
    states = int(seconds * 100) + 1
    poses = np.cumsum(rng.normal(size=(states, 6)), axis=0) * 0.1
    joints = poses * 0.5
    np.savez(
        folder / "robot_states.npz",
        robot_states=np.concatenate([joints, poses], axis=1).astype(np.float32),
        joints=joints.astype(np.float32),
        poses=poses.astype(np.float32),
    )
    metadata: dict[str, Any] = {
        "episode_name": folder.name,
        "start_time": start,
        "end_time": start + seconds,
        "camera_views": list(views),
        "sensor_hz": 130,
        "robot_hz": 100,
        "sensor_window_size": 13,
    }
    if sensor:
        windows = int(seconds * 10)
        np.savez(
            folder / "sensor_data.npz",
            timestamps=start + (np.arange(windows) + 1) * 0.1,
            data=rng.normal(size=(windows, 13, 1026)).astype(np.float32),
        )
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


@pytest.fixture(scope="session")
def stand_still() -> Callable[[Path], None]:
    """`stand_still(episode)`: each camera of an episode shows its first frame throughout."""

    def still(episode: Path) -> None:
        for view in (episode / "images").iterdir():
            first, *others = sorted(view.iterdir())
            for frame in others:
                shutil.copyfile(first, frame)

    return still


@pytest.fixture(scope="session")
def recorded_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of one task, to be copied; the last has one view only and no sensor."""
    root = tmp_path_factory.mktemp("recorded")
    _write_episode(root / "Touch_dot" / "episode_1", 1)
    _write_episode(root / "Touch_dot" / "episode_2", 2, seconds=3.0)
    _write_episode(root / "Press" / "episode_3", 3, views=("View2",), sensor=False)
    return root


@pytest.fixture(scope="session")
def make_document(demo_checkpoint: Path, recorded_once: Path) -> Callable[[Path], dict[str, Any]]:
    """`make_document(folder)` copies recordings there, and says what params.yaml would."""

    def make(folder: Path) -> dict[str, Any]:
        root = folder / "recordings"
        shutil.copytree(recorded_once, root)
        return {
            "data": {"root": str(root), "sources": [{"name": "made", "path": "."}]},
            "vlm": {
                "checkpoint": str(demo_checkpoint),
                "dtype": "float32",
                "image_resize_height": 56,
                "image_resize_width": 56,
                "pooling": ["mean", "image_mean", "view_mean"],
            },
            "extract": {"store": str(folder / "stores" / "made.zarr"), "batch_size": 4},
        }

    return make


@pytest.fixture
def document(make_document: Callable[[Path], dict[str, Any]], tmp_path: Path) -> dict[str, Any]:
    """params.yaml as it would be read, to be changed by a test."""
    return make_document(tmp_path)


@pytest.fixture
def recordings(document: dict[str, Any]) -> Path:
    """The folder of the recordings."""
    return Path(document["data"]["root"])


@pytest.fixture
def params(document: dict[str, Any]) -> Params:
    return Params.model_validate(document)


@pytest.fixture(scope="session")
def extracted_once(
    make_document: Callable[[Path], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The store that `params` make, to be copied."""
    params = Params.model_validate(make_document(tmp_path_factory.mktemp("extracted")))
    extract(params, lambda line: None)
    return params.extract.store


@pytest.fixture
def extracted(extracted_once: Path, params: Params) -> None:
    """`params` have been extracted already."""
    ledger = f"{extracted_once.name}.files.sqlite"
    shutil.copytree(extracted_once, params.extract.store)
    shutil.copyfile(extracted_once.with_name(ledger), params.extract.store.with_name(ledger))


@pytest.fixture
def params_file(document: dict[str, Any], tmp_path: Path) -> Path:
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def run(params: Params) -> tuple[Any, list[str]]:
    """The report of an extraction and the lines that it printed."""
    lines: list[str] = []
    return extract(params, lines.append), lines


def assert_same(found: FeatureStore, expected: FeatureStore) -> None:
    """All exactly, but features, whose batches differ, within the noise of float32."""
    for name in set(ARRAY_NAMES) - {"vl/features", "vl/checksum"}:
        assert np.array_equal(found.array(name), expected.array(name), equal_nan=True), name
    assert np.allclose(found.array("vl/features"), expected.array("vl/features"), atol=2e-5)


def missing_of(store: Path) -> set[int]:
    """The rows that the unfinished build of a store lacks."""
    with closing(StorePlaces(store).begun_build()) as build:
        return set(build.missing().tolist())


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The size of each batch that the model is given."""
    rows: list[int] = []
    real = FrozenVLM.submit

    def submit(self: FrozenVLM, batch: Any) -> Any:
        rows.append(len(batch))
        return real(self, batch)

    monkeypatch.setattr(FrozenVLM, "submit", submit)
    return rows


@pytest.fixture
def no_model_later(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """A call makes loading the model an error."""

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("nothing needs the model")

    return partial(monkeypatch.setattr, FrozenVLM, "load", refuse)


@pytest.fixture
def no_model(no_model_later: Callable[[], None]) -> None:
    """Loading the model is an error."""
    no_model_later()


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> Callable[[Params, int], None]:
    """`interrupted(params, rows)` stops as Ctrl-C does once this many rows are committed."""

    def stop(params: Params, rows: int) -> None:
        done: list[int] = []
        real = StoreBuild.mark

        def mark(self: StoreBuild, numbers: Any, *rest: Any) -> None:
            real(self, numbers, *rest)
            done.extend(numbers)
            if len(done) >= rows:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(StoreBuild, "mark", mark)
            with pytest.raises(KeyboardInterrupt):
                run(params)

    return stop


@pytest.fixture
def changed(document: dict[str, Any]) -> Callable[..., Params]:
    """`changed(vlm={"prompt": ...})`: the params with some values laid over."""

    return partial(laid_over, document)


def laid_over(document: dict[str, Any], **sections: dict[str, Any]) -> Params:
    """The params of a document with some values of its sections replaced."""
    merged = {name: {**document.get(name, {}), **sections.get(name, {})} for name in document}
    return Params.model_validate(merged)


FORKING = """
import json, os, signal, sys
import distributed, stages.extract, pipeline.extract.dask_cluster, pipeline.extract.engine
import transformers.models.qwen2_5_vl.modeling_qwen2_5_vl

running = set()
for line in iter(sys.stdin.readline, ""):
    asked = json.loads(line)
    if "poll" in asked:
        ended, status = os.waitpid(asked["poll"], os.WNOHANG)
        running.discard(ended)
        answer = os.waitstatus_to_exitcode(status) if ended else None
    elif answer := os.fork():
        running.add(answer)
    else:
        os.setsid()
        for number, (name, mode) in enumerate(
            [(os.devnull, os.O_RDONLY), *((name, os.O_WRONLY | os.O_CREAT) for name in asked["to"])]
        ):
            os.dup2(os.open(name, mode, 0o600), number)
        sys.argv[1:] = asked["arguments"]
        exec(asked["code"], {"__name__": "__main__"})
        sys.exit()
    print(json.dumps(answer), flush=True)
for process in running:
    os.kill(process, signal.SIGKILL)
"""
"""Forks processes that have imported what extraction needs, which takes each seconds otherwise."""


@dataclass
class Process:
    """A process that runs Python code to the end of its interpreter, in a session of its own."""

    pid: int
    stdout: Path
    stderr: Path
    _ask: Callable[..., Any]
    _code: int | None = None

    def poll(self) -> int | None:
        """Its exit code; minus the signal that it was killed by; None while it runs."""
        if self._code is None:
            self._code = self._ask(poll=self.pid)
        return self._code

    def kill(self) -> None:
        """SIGKILL, and wait for its end."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)
            self.wait()

    def wait(self) -> int:
        """Its exit code, once it has ended."""
        while (code := self.poll()) is None:
            time.sleep(0.02)
        return code


@pytest.fixture(scope="session")
def begin() -> Iterator[Callable[..., Process]]:
    """`begin(code, folder, *arguments)` begins a process whose output is kept in the folder."""
    with subprocess.Popen(
        [sys.executable, "-c", FORKING],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as server:
        asked, answers = server.stdin, server.stdout
        assert asked is not None
        assert answers is not None

        def ask(**what: Any) -> Any:
            asked.write(json.dumps(what) + "\n")
            asked.flush()
            return json.loads(answers.readline())

        def begin(code: str, folder: Path, *arguments: str) -> Process:
            number = len(list(folder.glob("*.stderr")))
            to = folder / f"{number}.stdout", folder / f"{number}.stderr"
            for path in to:
                path.touch()
            pid = ask(code=code, arguments=arguments, to=[str(path) for path in to])
            return Process(pid, *to, ask)

        yield begin
