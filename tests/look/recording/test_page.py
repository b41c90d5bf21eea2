"""The page of recordings: all of it there; which to look at, and what is not there said."""

import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.base.config import Params, Source, load_params
from pipeline.base.errors import Issue
from pipeline.base.text import Table
from pipeline.data import open_recordings
from pipeline.look.page.blocks import Issues, Picture, Report, Text, Tokens
from pipeline.look.page.writing import write_report
from pipeline.look.recording.page import RecordingsOverview, recordings_report, survey_recordings
from pipeline.look.subject import subject_of
from tests.look.recording.conftest import PARAMS

PARAMS_FILE = Path(__file__).resolve().parents[3] / "params.yaml"


@pytest.fixture
def params_of(demo_checkpoint: Path) -> Callable[..., Params]:
    def load(path: Path, *more: str) -> Params:
        checkpoint = f"vlm.checkpoint={demo_checkpoint}"
        return load_params(PARAMS_FILE, [f"inspect.path={path}", checkpoint, *more])

    return load


def report_of(params: Params) -> Report:
    subject = subject_of(params)
    return recordings_report(subject.recordings(None), params, subject.name)


@pytest.mark.slow
def test_the_page_of_a_recording_is_sound(recorded, params_of, tmp_path, assert_page_is_sound):
    report = report_of(params_of(recorded, "inspect.samples=2", "inspect.ticks=2"))
    assert_page_is_sound(write_report(tmp_path, report)[0])


def test_the_page_of_a_recording_is_whole(recorded: Path, params_of: Callable[..., Params]) -> None:
    report = report_of(params_of(recorded, "inspect.samples=2", "inspect.ticks=2"))
    names = {picture.name.rpartition("-")[2] for picture in report.blocks(Picture)}
    assert names == {"views", "sensor", "motion", "clocks", "samples"}
    (clocks,) = [table for table in report.blocks(Table) if table.columns[0] == "clock"]
    usual, average = map(clocks.columns.index, ("usual rate [Hz]", "on average [Hz]"))
    # The simulated recorder loses five rows of the robot's.
    (state,) = [row for row in clocks.rows if row[0] == "state"]
    assert 95 < state[average] < state[usual] - 0.5
    (sensor,) = [one for one in report.blocks(Picture) if one.name.endswith("sensor")]
    assert "by 6 times its noise" in sensor.caption
    (prompt,) = report.blocks(Tokens)
    sizes = next(one for one in report.blocks(Table) if "image tokens" in one.columns)
    assert [row[1:3] for row in sizes.rows] == [("126 × 224", "112 × 168")] * 3
    assert [run.note for run in prompt.runs if run.kind == "image"] == [
        f"× 24, {view}" for view in ("View1", "View2", "View5")
    ]


def test_what_is_missing_is_said(recorded, params_of, tmp_path):
    lab = Path(shutil.copytree(recorded, tmp_path / "lab"))
    (folder,) = lab.iterdir()
    sensor = next(path for path in folder.iterdir() if "sensor" in path.name)
    sensor.write_bytes(b"no archive")
    report = report_of(params_of(lab, f"vlm.checkpoint={tmp_path / 'nowhere'}"))
    assert dict(report.tiles)["errors"] == "1"
    said = "\n".join(text.words for text in report.blocks(Text))
    assert str(sensor) in said
    assert "No sample can be made" in said
    assert ".. " not in said
    assert "nowhere" in said and "python -m stages.demo" in said
    first = next(report.blocks(Issues))
    assert [one.severity for one in first.issues] == ["error"]
    assert folder.name in first.issues[0].episode


def survey(*sources: Source) -> RecordingsOverview:
    return survey_recordings(open_recordings(sources), PARAMS)


@pytest.fixture
def many(healthy: Path, tmp_path: Path) -> Path:
    """Three old episodes that differ."""
    (episode,) = (healthy / "old" / "Red_point").iterdir()
    for name in "abc":
        folder = Path(shutil.copytree(episode, tmp_path / "many" / name))
        document = pickle.loads((folder / "data.pkl").read_bytes())
        document["action"][1, 0] += 0.001 * ord(name)
        (folder / "data.pkl").write_bytes(pickle.dumps(document))
    return tmp_path / "many"


def test_healthy_recordings_of_every_format(healthy: Path) -> None:
    names = ("raw", "new", "old")
    found = survey(*(Source(name=name, path=str(healthy / name)) for name in names))
    assert found.issues == ()
    assert found.views == ("View1", "View2", "View5") and found.rotation == "rotvec"
    assert [one.source for one in found.summaries] == list(names)
    for one in found.summaries:
        assert one.format == one.source and one.instruction
        assert one.ticks > 30 and one.vl_rows == -(-one.ticks // 3)
        assert one.duration_s == pytest.approx(one.ticks / 10, abs=0.5)
        assert set(one.frames) == {"View1", "View2", "View5"} and min(one.frames.values()) > 30
    # Only the LeRobot episode has no poses beside its actions: formats may differ in streams.
    paths = tuple(str(healthy / name) for name in (*names, "lerobot"))
    assert survey(Source(name="s", path=paths)).issues == ()


def test_one_broken_episode_hides_no_other(many: Path) -> None:
    pickled = many / "b" / "data.pkl"
    pickled.write_bytes(pickled.read_bytes()[:1000])
    found = survey(Source(name="s", path=str(many)))
    assert [one.episode for one in found.summaries] == ["a", "b", "c"]
    assert [one.errors for one in found.summaries] == [0, 1, 0]
    broken = found.summaries[1]
    assert (broken.ticks, broken.counts, broken.instruction) == (0, {}, None)
    # The file is the issue; that its streams are absent follows and is not told again.
    (issue,) = found.issues
    assert broken.issues == [issue] and issue.severity == "error"
    assert found.choose(1) == (1,) and found.choose(2) == (0, 1) and found.choose(9) == (0, 1, 2)


def test_episodes_that_cannot_be_opened(healthy: Path, tmp_path: Path) -> None:
    (episode,) = (healthy / "new" / "Red_point").iterdir()
    shutil.copytree(episode, tmp_path / "new" / "good")
    shutil.copytree(episode, tmp_path / "new" / "bad")
    (tmp_path / "new" / "bad" / "metadata.json").write_text("{")
    found = survey(Source(name="s", path=str(tmp_path / "new")))
    assert [one.episode for one in found.summaries] == ["good"]
    (issue,) = found.issues
    assert (issue.kind, issue.severity, issue.episode) == ("unreadable", "error", "bad")
    assert found.summaries[0].errors == 0


def test_the_choice_spreads_over_sound_episodes(healthy: Path) -> None:
    (one,) = survey(Source(name="s", path=str(healthy / "old"))).summaries
    summaries = [replace(one, episode=str(place), issues=[]) for place in range(11)]
    found = RecordingsOverview(tuple(summaries), (), "rotvec")
    assert found.choose(3) == (0, 5, 10) and found.choose(1) == (0,)
    warning, error = (Issue(severity=how, kind="gap", message="") for how in ("warning", "error"))
    for place, issues in {7: [warning] * 2, 8: [error], 3: [warning] * 3}.items():
        summaries[place].issues = issues
    assert found.choose(1) == (8,) and found.choose(2) == (3, 8)
    assert found.choose(5) == (0, 3, 7, 8, 10) and found.choose(99) == tuple(range(11))
