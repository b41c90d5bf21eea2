"""Episodes become Rerun files that hold every stream, camera and the age of the features."""

import re
import sys
from pathlib import Path
from subprocess import run

import pytest

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError
from pipeline.look.rerun_files import write_episodes
from pipeline.look.subject import subject_of
from pipeline.store import FeatureStore


def params_of(path: Path, output: Path) -> Params:
    return Params.model_validate(
        {
            "data": {"sources": [{"name": "raw", "path": "raw"}]},
            "vlm": {"checkpoint": "none"},
            "inspect": {"path": str(path), "output": str(output), "episodes": 1},
        }
    )


def rows_by_place(file: Path) -> dict[str, int]:
    """How many rows each place of a file has, besides what is static."""
    rerun = Path(sys.executable).with_name("rerun")
    printed = run([rerun, "rrd", "print", file], capture_output=True, text=True, check=True).stdout
    rows: dict[str, int] = {}
    for count, place, columns in re.findall(
        r"with (\d+) rows .*? - /(\S+) - .*?: \[(.*)\]", printed
    ):
        if "SeriesLines" not in columns:
            rows[place] = rows.get(place, 0) + int(count)
    return rows


@pytest.mark.extra
def test_a_recording_is_there_with_all_that_moves_in_it(recorded, tmp_path):
    pytest.importorskip("rerun")
    params = params_of(recorded, tmp_path / "out")
    subject = subject_of(params)
    (recording,) = subject.recordings(None).recordings
    (file,) = write_episodes(subject, params)
    rows = rows_by_place(file)
    for place, stream in (("state", recording.state()), ("sensor/force", recording.sensor())):
        assert stream is not None and rows[place] == len(stream.time)
    for view, camera in recording.cameras().items():
        assert rows[f"views/{view}"] == len(camera.time)
    assert rows["action"] == rows["features/age_s"] > 10 and rows["sensor/image"] > 10


@pytest.mark.extra
def test_a_store_is_there_with_the_similarity_of_its_rows(tiny_store, tmp_path):
    pytest.importorskip("rerun")
    path = tiny_store(tmp_path)
    params = params_of(path, tmp_path / "out")
    (file,) = write_episodes(subject_of(params), params)
    episode, rows = FeatureStore.open(path).episodes[0], rows_by_place(file)
    assert rows["action"] == rows["features/age_s"] == len(episode.ticks)
    assert rows["features/similarity"] == len(episode.vl_rows)
    assert rows["state"] == len(episode.states)


def test_without_rerun_the_error_says_what_to_install(tiny_store, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    params = params_of(tiny_store(tmp_path), tmp_path / "out")
    with pytest.raises(ConfigError, match=r"\[rerun\]"):
        write_episodes(subject_of(params), params)
