"""The page of recordings: all of it there, and what is not there said in words."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pipeline.config import Params, load_params
from pipeline.inspection.facts import ChannelStatistics, Flaw, PromptToken
from pipeline.report import (
    Block,
    Chart,
    Document,
    Notices,
    Picture,
    Report,
    Section,
    Table,
    Text,
    Tokens,
    write_report,
)
from pipeline.report.flaws import notices
from pipeline.report.model_input import runs
from pipeline.report.recording import recordings_report
from pipeline.report.statistics_table import statistics_table
from pipeline.report.subject import subject_of
from pipeline.simulation.insertion_formats import write_raw
from pipeline.simulation.recorder import simulate_episode

PARAMS = Path(__file__).resolve().parents[2] / "params.yaml"
EPOCH_S = 1.767e9 + 0.25


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one raw recording."""
    folder = tmp_path_factory.mktemp("lab") / "raw"
    write_raw(folder, simulate_episode(4, EPOCH_S))
    return folder


@pytest.fixture
def params_of(demo_checkpoint: Path) -> Callable[..., Params]:
    def load(path: Path, *more: str) -> Params:
        checkpoint = f"vlm.checkpoint={demo_checkpoint}"
        return load_params(PARAMS, [f"inspect.path={path}", checkpoint, *more])

    return load


def report_of(params: Params) -> Report:
    subject = subject_of(params)
    return recordings_report(subject.recordings(None), params, subject.name)


def blocks_of(sections: list[Section]) -> Iterator[Block]:
    for section in sections:
        yield from section.blocks
        yield from blocks_of(list(section.parts))


def words_of(report: Report) -> str:
    return "\n".join(one.words for one in blocks_of(report.sections) if isinstance(one, Text))


def test_the_page_of_a_recording_is_whole_and_sound(
    recorded: Path,
    params_of: Callable[..., Params],
    tmp_path: Path,
    assert_page_is_sound: Callable[[Path], None],
) -> None:
    report = report_of(params_of(recorded))
    blocks = list(blocks_of(report.sections))
    files = write_report(tmp_path, report)
    names = {file.stem.rpartition("-")[2] for file in files[1:]}
    assert names == {"views", "sensor", "motion", "clocks", "steps", "samples", "batch"}
    assert sum(isinstance(one, Chart) for one in blocks) == 1
    (document,) = (one for one in blocks if isinstance(one, Document))
    assert document.content["digest"]
    (prompt,) = (one for one in blocks if isinstance(one, Tokens))
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
    assert "nowhere" in said and "python -m stages.demo" in said
    first = next(one for one in blocks_of(report.sections) if isinstance(one, Notices))
    assert [one.severity for one in first.notices] == ["error"]
    assert folder.name in first.notices[0].where


def test_all_episodes_are_checked_and_some_are_shown(
    recorded: Path, params_of: Callable[..., Params], tmp_path: Path
) -> None:
    (episode,) = recorded.iterdir()
    for index in range(4):
        shutil.copytree(episode, tmp_path / f"episode_{index}")
    report = report_of(params_of(tmp_path, "inspect.episodes=2"))
    table = next(one for one in blocks_of(report.sections) if isinstance(one, Table))
    assert [row[0] for row in table.rows] == [f"episode_{index}" for index in range(4)]
    assert table.strong == {0, 3}
    titles = [section.title for section in report.sections]
    assert titles[2:4] == ["episode_0", "episode_3"]
    names = [one.name for one in blocks_of(report.sections) if isinstance(one, Picture)]
    assert "episode1-episode_0-views" in names and "episode2-episode_3-views" in names


def test_a_flaw_of_many_episodes_is_one_notice() -> None:
    flaws = [
        Flaw("gap", "warning", "lab", f"e{index}", "view View1", 100.5, 101.0, f"found {index}")
        for index in range(200)
    ]
    flaws += [Flaw("unreadable", "error", "lab", "e7", "episode", None, None, "no file")]
    zeros = {("lab", f"e{index}"): 100.0 for index in range(200)}
    error, gap = notices(flaws, zeros)
    assert (error.severity, error.kind, error.where) == ("error", "unreadable", "e7")
    assert gap.where == (
        "view View1 · 200 episodes · e0 0.50–1.00 s; e1 0.50–1.00 s; e2 0.50–1.00 s; and 197 more"
    )
    assert gap.message == "The first: found 0"


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
