"""The page of recordings: all of it there, and what is not there said in words."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.base.config import Params, load_params
from pipeline.base.text import Table
from pipeline.look.page.blocks import Issues, Picture, Report, Text, Tokens
from pipeline.look.page.writing import write_report
from pipeline.look.recording.page import recordings_report
from pipeline.look.subject import subject_of

PARAMS = Path(__file__).resolve().parents[3] / "params.yaml"


@pytest.fixture
def params_of(demo_checkpoint: Path) -> Callable[..., Params]:
    def load(path: Path, *more: str) -> Params:
        checkpoint = f"vlm.checkpoint={demo_checkpoint}"
        return load_params(PARAMS, [f"inspect.path={path}", checkpoint, *more])

    return load


def report_of(params: Params) -> Report:
    subject = subject_of(params)
    return recordings_report(subject.recordings(None), params, subject.name)


def words_of(report: Report) -> str:
    return "\n".join(one.words for one in report.blocks(Text))


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
    said = words_of(report)
    assert str(sensor) in said
    assert "No sample can be made" in said
    assert ".. " not in said
    assert "nowhere" in said and "python -m stages.demo" in said
    first = next(report.blocks(Issues))
    assert [one.severity for one in first.issues] == ["error"]
    assert folder.name in first.issues[0].episode


def test_all_episodes_are_checked_and_some_are_shown(recorded, params_of, tmp_path):
    (episode,) = recorded.iterdir()
    for index in range(4):
        shutil.copytree(episode, tmp_path / f"episode_{index}")
    report = report_of(params_of(tmp_path, "inspect.episodes=2"))
    table = next(report.blocks(Table))
    assert [row[1] for row in table.rows] == [f"episode_{index}" for index in range(4)]
    # The copies of the first have issues, so that they come before it.
    assert table.strong == {1, 2}
    titles = [section.title for section in report.sections]
    assert titles[2:4] == ["episode_1", "episode_2"]
    names = [one.name for one in report.blocks(Picture)]
    assert "episode1-episode_1-views" in names and "episode2-episode_2-views" in names
