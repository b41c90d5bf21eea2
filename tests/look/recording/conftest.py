"""Healthy simulated recordings of every format, and copies of them that a test may damage."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from pipeline.base.config import DataParams, Params, Source
from pipeline.base.errors import Issue
from pipeline.data import open_recordings
from pipeline.data.timeline import choose_action_rotation
from pipeline.look.page.style import RC
from pipeline.look.recording.episode import LoadedRecording, view_episode
from pipeline.look.recording.page import find_issues
from pipeline.simulation import rendering
from pipeline.simulation.insertion_formats import (
    ABUTTING,
    write_lerobot,
    write_new,
    write_old,
    write_raw,
)
from pipeline.simulation.recorder import simulate_episode

EPOCH_S = 1.767e9 + 0.25
PARAMS = Params.model_validate(
    {"data": {"sources": [{"name": "s", "path": "."}]}, "vlm": {"checkpoint": "none"}}
)


@pytest.fixture(autouse=True)
def common_style() -> Iterator[None]:
    """As the page draws them."""
    with mpl.rc_context(RC):
        yield


@pytest.fixture(scope="session")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`raw/`, `new/`, `old/` and `lerobot/`: the same episode in each, seen by other clocks.

    By cameras without noise, so that a scene that stands still gives equal frames.
    """
    root = tmp_path_factory.mktemp("healthy")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "_NOISE", 0.0)
        episode = simulate_episode(23, EPOCH_S)
        write_raw(root / "raw" / "Red_point", episode)
        write_new(root / "new" / "Red_point", episode, ABUTTING, robot_clock=True)
        write_old(root / "old" / "Red_point", episode)
        write_lerobot(root / "lerobot", iter([episode]))
    return root


@pytest.fixture
def copied(healthy: Path, tmp_path: Path) -> Callable[[str], Path]:
    """`copied("raw")`: the episode folder (or LeRobot root) of a copy that a test may damage."""

    def copy(format: str) -> Path:
        folder = Path(shutil.copytree(healthy / format, tmp_path / format))
        return folder if format == "lerobot" else next((folder / "Red_point").iterdir())

    return copy


@pytest.fixture(scope="session")
def look() -> Callable[..., LoadedRecording]:
    """`look(folder, action_hz=10)`: the one recording there, as far as it can be read."""

    def view(folder: Path, **data: Any) -> LoadedRecording:
        source = Source(name="s", path=str(folder))
        params = DataParams(sources=(source,), **data)
        (recording,) = open_recordings([source], views=params.views).recordings
        return view_episode(recording, params, choose_action_rotation("auto", [recording]))

    return view


@pytest.fixture(scope="session")
def issues_of(look: Callable[..., LoadedRecording]) -> Callable[..., tuple[Issue, ...]]:
    """`issues_of(folder)`: what looks wrong in the one recording there, by its own clock."""

    def find(folder: Path, **data: Any) -> tuple[Issue, ...]:
        view = look(folder, **data)
        found = find_issues(view)
        assert not any("\n" in issue.message for issue in found)
        # Tests know when files were stamped.
        return tuple(
            issue
            if issue.start_s is None or issue.stop_s is None
            else replace(issue, start_s=issue.start_s + view.zero, stop_s=issue.stop_s + view.zero)
            for issue in found
        )

    return find


@pytest.fixture(scope="session")
def change_npz() -> Callable[..., None]:
    """`change_npz(path, values=function)`: rewrite members of a .npz by functions of themselves."""

    def change(path: Path, **changes: Callable[[np.ndarray], np.ndarray]) -> None:
        with np.load(path) as archive:
            members = {name: archive[name] for name in archive.files}
        np.savez(path, **members | {name: how(members[name]) for name, how in changes.items()})

    return change


@pytest.fixture(scope="session")
def change_csv() -> Callable[[Path, Callable[[np.ndarray], np.ndarray]], None]:
    """`change_csv(path, function)`: rewrite the table of a robot-state CSV."""

    def change(path: Path, how: Callable[[np.ndarray], np.ndarray]) -> None:
        header = path.read_text().splitlines()[0]
        table = how(np.loadtxt(path, delimiter=",", skiprows=1))
        np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.6f")

    return change


@pytest.fixture(scope="session")
def view(healthy: Path, look: Callable[..., LoadedRecording]) -> LoadedRecording:
    """A raw episode of three views, whose robot's clock has a gap, not to be changed."""
    return look(healthy / "raw")
