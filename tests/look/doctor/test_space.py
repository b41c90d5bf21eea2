"""Room for the store, on the disk and in memory."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.base.config import Params
from pipeline.base.errors import VLMError
from pipeline.data import open_recordings
from pipeline.look.doctor import data
from pipeline.look.doctor.space import (
    check,
    check_disk,
    check_page_cache,
    estimated_bytes,
    measure,
)
from stages import extract
from stages.command import run

GIB = 2**30


@pytest.mark.parametrize(
    ("free", "there", "severity"),
    [
        (11, None, "ok"),
        (9, None, "error"),
        (9, "lab.zarr.part", "note"),
        (9, "lab.zarr", "note"),
        (11, "lab.zarr", "ok"),
    ],
)
def test_room_for_the_store(tmp_path: Path, free: int, there: str | None, severity: str) -> None:
    store = tmp_path / "lab.zarr"
    if there:
        (tmp_path / there).mkdir()
    issue = check_disk(10 * GIB, "about 10.0 GiB", store, free * GIB)
    assert issue.severity == severity
    assert issue.message.startswith(f"about 10.0 GiB; {free}.0 GiB free")
    assert ("set extract.store to another disk" in issue.remedy) == (severity != "ok")


def test_memory() -> None:
    assert check_page_cache(10 * GIB, 16 * GIB).severity == "ok"
    assert check_page_cache(10 * GIB, 12 * GIB).severity == "note"


def test_the_estimate_is_what_extraction_takes(
    tmp_path: Path, demo_checkpoint: Path, recordings: Path
) -> None:
    document: dict[str, Any] = {
        "data": {
            "root": str(recordings),
            "sources": [{"name": "raw", "path": "raw"}, {"name": "new", "path": "new"}],
        },
        "vlm": {
            "checkpoint": str(demo_checkpoint),
            "dtype": "float32",
            "image_resize_height": 28,
            "image_resize_width": 28,
        },
        "extract": {"store": str(tmp_path / "made.zarr"), "device": "cpu"},
    }
    params = Params.model_validate(document)
    opened = open_recordings(params.data.sources, recordings)
    read, bad = measure(opened.recordings, params.data)
    assert len(read) == 4 and not bad
    before = estimated_bytes(read, 4, params)
    assert estimated_bytes(read, 400, params) == pytest.approx(100 * before, rel=1e-2)
    disk, _ = check(params)
    assert disk.severity == "ok" and " for 4 episodes; " in disk.message
    assert not list(tmp_path.glob("made*")), "a check writes nothing"
    file = tmp_path / "params.yaml"
    file.write_text(yaml.safe_dump(document))
    assert run("", extract.main, ["--params", str(file)]) == 0
    # Chunk files are whole pages, and metadata takes some.
    files = [file for file in (tmp_path / "made.zarr").rglob("*") if file.is_file()]
    assert before < sum(file.stat().st_blocks * 512 for file in files) < 1.5 * before + 2**20


def test_without_a_checkpoint_the_size_is_not_known() -> None:
    params = Params.model_validate(
        {"data": {"sources": [{"name": "a", "path": "."}]}, "vlm": {"checkpoint": "/no/such"}}
    )
    (issue,) = check(params)
    assert issue.severity == "note" and "vlm.checkpoint" in issue.message


def test_without_recordings_the_size_is_not_known(tmp_path: Path, demo_checkpoint: Path) -> None:
    """The recordings' own group says why."""
    document = {
        "data": {"root": str(tmp_path), "sources": [{"name": "a", "path": "a"}]},
        "vlm": {"checkpoint": str(demo_checkpoint)},
    }
    (issue,) = check(Params.model_validate(document))
    assert issue.severity == "note" and "no episode could be read" in issue.message


@pytest.mark.parametrize(("on_bad", "level"), [("stop", "error"), ("skip", "note")])
def test_an_episode_that_cannot_be_used_is_said_and_the_others_give_the_size(
    tmp_path: Path,
    recordings: Path,
    demo_checkpoint: Path,
    on_bad: str,
    level: str,
) -> None:
    """It opens, so that the recordings' own group finds nothing."""
    shutil.copytree(recordings / "raw", tmp_path / "raw")
    states = sorted(tmp_path.glob("raw/**/robot_state_*.csv"))
    head, *rows = states[0].read_text().splitlines()
    rows[7] = ",".join([*rows[7].split(",")[:-1], "nan"])
    states[0].write_text("\n".join([head, *rows]))
    params = Params.model_validate(
        {
            "data": {
                "root": str(tmp_path),
                "sources": [{"name": "a", "path": "raw"}],
                "on_bad_episode": on_bad,
            },
            "vlm": {"checkpoint": str(demo_checkpoint)},
        }
    )
    assert {issue.severity for issue in data.check(params)} == {"ok"}
    bad, disk, *_ = check(params)
    assert (bad.severity, bad.kind) == (level, "episodes")
    assert "1 episode(s) read for the size cannot be used" in bad.message
    assert str(states[0]) in bad.message
    assert "data.on_bad_episode" in bad.remedy
    assert disk.severity == "ok" and "for 1 episodes;" in disk.message


def test_params_that_the_checkpoint_cannot_meet_are_said(
    recordings: Path, demo_checkpoint: Path
) -> None:
    document = {
        "data": {"root": str(recordings), "sources": [{"name": "a", "path": "raw"}]},
        "vlm": {"checkpoint": str(demo_checkpoint), "layers": [99]},
    }
    with pytest.raises(VLMError, match="99"):
        list(check(Params.model_validate(document)))


def test_where_every_episode_is_bad_the_size_is_not_known(
    tmp_path: Path, recordings: Path, demo_checkpoint: Path
) -> None:
    shutil.copytree(recordings / "raw", tmp_path / "raw")
    for stream in tmp_path.glob("raw/**/robot_state_*.csv"):
        stream.unlink()
    document = {
        "data": {
            "root": str(tmp_path),
            "sources": [{"name": "a", "path": "raw"}],
            "on_bad_episode": "skip",
        },
        "vlm": {"checkpoint": str(demo_checkpoint)},
    }
    params = Params.model_validate(document)
    opened = open_recordings(params.data.sources, params.data.root)
    assert opened.bad and not opened.recordings
    (issue,) = check(params)
    assert issue.severity == "note"
    assert issue.message == "not known: no episode could be read; see above"
