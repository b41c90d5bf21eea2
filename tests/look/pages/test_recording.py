"""The page of recordings: all of it there, and what is not there said in words."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.base.config import Params, load_params
from pipeline.look.page.blocks import Document, Issues, Picture, Report, Table, Text, Tokens
from pipeline.look.page.writing import write_report
from pipeline.look.recording.facts import ChannelStatistics, Flaw, PromptToken
from pipeline.look.recording.page import recordings_report
from pipeline.look.recording.page_episode import jitter_unit
from pipeline.look.recording.page_flaws import notices
from pipeline.look.recording.page_model_input import runs, stretched
from pipeline.look.recording.page_statistics import statistics_table
from pipeline.look.recording.subject import subject_of

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


def test_the_page_of_a_recording_is_whole_and_sound(
    recorded: Path,
    params_of: Callable[..., Params],
    tmp_path: Path,
    assert_page_is_sound: Callable[[Path], None],
) -> None:
    # Few samples and ticks: five of each are drawn in tests/plots.
    report = report_of(params_of(recorded, "inspect.samples=2", "inspect.ticks=2"))
    files = write_report(tmp_path, report)
    names = {file.stem.rpartition("-")[2] for file in files if file.suffix == ".png"}
    assert names == {"views", "sensor", "motion", "clocks", "steps", "samples", "batch"}
    (clocks,) = [table for table in report.blocks(Table) if table.columns[0] == "clock"]
    usual, average = map(clocks.columns.index, ("usual rate [Hz]", "on average [Hz]"))
    # The simulated recorder loses five rows of the robot's.
    (state,) = [row for row in clocks.rows if row[0] == "state"]
    assert 95 < state[average] < state[usual] - 0.5
    (sensor,) = [one for one in report.blocks(Picture) if one.name.endswith("sensor")]
    assert "by 6 times its noise" in sensor.caption
    (document,) = report.blocks(Document)
    assert document.content["digest"]
    (prompt,) = report.blocks(Tokens)
    sizes = next(one for one in report.blocks(Table) if "image tokens" in one.columns)
    assert [row[1:3] for row in sizes.rows] == [("126 × 224", "112 × 168")] * 3
    assert [run.note for run in prompt.runs if run.kind == "image"] == [
        f"× 24, {view}" for view in ("View1", "View2", "View5")
    ]
    assert_page_is_sound(files[0])


def test_what_is_missing_is_said(
    recorded: Path, params_of: Callable[..., Params], tmp_path: Path
) -> None:
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


def test_all_episodes_are_checked_and_some_are_shown(
    recorded: Path, params_of: Callable[..., Params], tmp_path: Path
) -> None:
    (episode,) = recorded.iterdir()
    for index in range(4):
        shutil.copytree(episode, tmp_path / f"episode_{index}")
    report = report_of(params_of(tmp_path, "inspect.episodes=2"))
    table = next(report.blocks(Table))
    assert [row[0] for row in table.rows] == [f"episode_{index}" for index in range(4)]
    # The copies of the first are flaws, so that they come before it.
    assert table.strong == {1, 2}
    titles = [section.title for section in report.sections]
    assert titles[2:4] == ["episode_1", "episode_2"]
    names = [one.name for one in report.blocks(Picture)]
    assert "episode1-episode_1-views" in names and "episode2-episode_2-views" in names


def test_what_the_model_sees_in_another_shape_is_said() -> None:
    recorded = {"a": (480, 640), "b": (480, 640), "c": (720, 1280), "d": (700, 700)}
    assert stretched({"c": (720, 1280)}, (364, 644)) == []
    wide, square = stretched(recorded, (364, 644))
    assert "33% in width: a, b, recorded as 480 × 640 pixels, for the model 364 × 644" in wide
    assert "77% in width: d" in square and "`vlm.image_resize_height`" in square
    (high,) = stretched({"c": (720, 1280)}, (200, 200))
    assert "78% in height: c" in high


def test_flaws_count_time_as_the_page_does() -> None:
    flaws = [
        Flaw("gap", "warning", "lab", f"e{index}", "view View1", 100.5, 101.0, f"found {index}")
        for index in range(200)
    ]
    flaws += [Flaw("unreadable", "error", "lab", "e7", "episode", None, None, "no file")]
    zeros = {("lab", f"e{index}"): 100.0 for index in range(200)}
    *gaps, error = notices(flaws, zeros)
    assert (error.severity, error.kind, error.stream) == ("error", "unreadable", "")
    assert {(one.start_s, one.stop_s) for one in gaps} == {(0.5, 1.0)}


def test_channels_that_differ_by_a_number_are_one_row() -> None:
    def channel(name: str, value: float) -> ChannelStatistics:
        seven = (value, value, value, value, value + 1, value, 0.0)
        return ChannelStatistics("sensor", name, "N", 10, *seven)

    many = [channel(f"aline_{depth:04d}", depth) for depth in range(100)]
    table = statistics_table([channel("force", 5.0), *many])
    force, joint = table.rows
    assert force[1] == "force"
    assert joint[1] == "aline_0000 … aline_0099 (100 channels)"
    assert joint[4:] == (0, 49.5, 49.5, 49.5, 100, 49.5, 0.0)


def test_image_tokens_are_folded_view_by_view() -> None:
    def token(text: str, kind: str, view: str | None = None) -> PromptToken:
        return PromptToken(0, text, kind, view)  # pyright: ignore[reportArgumentType]

    tokens = [token("<s>", "special"), token("<e>", "special"), token("a", "text")]
    tokens += [token("b", "text"), *[token("<i>", "image", "View1")] * 3]
    tokens += [token("<i>", "image", "View2")]
    assert [(run.text, run.kind, run.note) for run in runs(tokens)] == [
        ("<s>", "special", ""),
        ("<e>", "special", ""),
        ("ab", "text", ""),
        ("<i>", "image", "× 3, View1"),
        ("<i>", "image", "× 1, View2"),
    ]


@pytest.mark.parametrize(
    ("jitters_s", "unit"),
    [
        ([0.027574, 2e-6, float("nan")], "ms"),
        ([9.2e-4], "µs"),
        ([1.5, 0.1], "s"),
        ([0.0], "µs"),
        ([float("nan")], "µs"),
    ],
)
def test_jitter_is_told_in_a_unit_of_its_size(jitters_s: list[float], unit: str) -> None:
    name, seconds = jitter_unit(jitters_s)
    assert name == unit and seconds == {"s": 1, "ms": 1e-3, "µs": 1e-6}[unit]
