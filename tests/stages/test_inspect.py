"""`stages.inspect` as a user meets it: the page, the summary, exit codes."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.errors import Issue
from pipeline.look.page.blocks import Issues, Report, Section
from pipeline.look.page.style import RC
from stages import inspect
from stages.command import run
from tests.data.conftest import Truth, png, write_raw

Said = pytest.CaptureFixture[str]
Make = Callable[..., Any]

PARAMS = Path(__file__).resolve().parents[2] / "params.yaml"


@pytest.fixture
def looked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, demo_checkpoint: Path) -> Make:
    """`looked(*arguments)`: the exit code of the command, run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    options = ["--params", str(PARAMS), "--set", f"vlm.checkpoint={demo_checkpoint}"]

    def look(*arguments: object) -> int:
        words = [*map(str, arguments), *options]
        return run("", inspect.main, words, shorthands=inspect.SHORTHANDS)

    return look


def test_recordings_and_a_damaged_one_are_a_page(looked, recorded, tmp_path, capsys):
    (episode,) = recorded.iterdir()
    for name in ("sound", "broken"):
        shutil.copytree(episode, tmp_path / "lab" / name)
    next(tmp_path.glob("lab/broken/*sensor*")).write_bytes(b"no archive")
    # As a shell hands out lab/*.
    few = ("inspect.episodes=1", "inspect.samples=1", "inspect.ticks=1")
    options = [word for one in few for word in ("--set", one)]
    assert looked("lab/broken", "lab/sound", *options) == 0
    page = Path("reports/inspect/lab_broken_and_1_more/report.html")
    out = capsys.readouterr().out
    assert "episodes 2 · " in out and "errors 1" in out
    assert "error: unreadable: " in out and "broken" in out
    assert out.splitlines()[-1].startswith(f"{page}: ")
    assert "error,unreadable," in page.with_name("findings.csv").read_text()
    assert page.is_file() and len(list(page.parent.glob("*.png"))) >= 3


def test_a_path_needs_no_params_file(recorded, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    few = ["--set", "inspect.samples=1", "--set", "inspect.ticks=1"]
    assert run("", inspect.main, [str(recorded), *few], shorthands=inspect.SHORTHANDS) == 0
    out = capsys.readouterr().out
    assert out.startswith("no params.yaml in this folder: every key has its default\n")
    assert "episodes 1 · " in out and list(tmp_path.rglob("report.html"))
    for words in ([], [str(recorded), "--params", "mine.yaml"]):
        assert run("", inspect.main, words, shorthands=inspect.SHORTHANDS) == 2
        assert ".yaml: no such file. Run from the project's root" in capsys.readouterr().err


def test_a_korean_name_lacks_a_font_and_grey_frames_of_16_bits_are_not_white(
    looked, tmp_path, capsys, monkeypatch
):
    """A warning of matplotlib's would be an error here."""
    episode = write_raw(tmp_path / "바늘_삽입", Truth(), views=("View1",))
    for number, frame in enumerate(sorted(episode.rglob("*.jpg"))):
        frame.with_suffix(".png").write_bytes(png(20 + 30 * number, grey_of_16_bits=True))
        frame.unlink()
    monkeypatch.setitem(RC, "font.family", ["DejaVu Sans"])
    few = ("inspect.samples=1", "inspect.ticks=1", "inspect.output=mine")
    assert looked("바늘_삽입", *(word for one in few for word in ("--set", one))) == 0
    out = capsys.readouterr().out
    assert "cameras 1" in out and "of one colour" not in out
    page = (tmp_path / "mine/report.html").read_text(encoding="utf-8")
    assert "바늘_삽입" in page


def test_a_store_is_a_page(looked: Make, tiny_store: Make, tmp_path: Path, capsys: Said) -> None:
    store = tiny_store(tmp_path)
    assert looked(store, "--set", "inspect.output=mine") == 0
    assert "Store: tiny.zarr\nepisodes 6 · " in capsys.readouterr().out
    assert (tmp_path / "mine/report.html").is_file()


def test_the_summary_says_the_worst_first_and_how_much_more_there_is() -> None:
    found = [
        Issue(severity="warning", kind=f"gap {kind}", message="x", episode="e1", start_s=1.0)
        for kind in range(9)
    ]
    broken = "two\n  lines"
    found.append(Issue(severity="error", kind="unreadable", message=broken, episode="e9"))
    report = Report("R", "", [("episodes", "9")], [Section("S", [Issues(found, "fine")])])
    lines = list(inspect.summary(report))
    assert lines[:4] == ["R", "episodes 9", "error: unreadable: e9", "    two lines"]
    assert lines[4:6] == ["warning: gap 0: e1 1.00 s", "    x"]
    assert lines[-1] == "… and 2 more on the page and in findings.csv"
    assert len(lines) == 2 + 2 * inspect.SHOWN + 1
    gap = Issue(severity="warning", kind="gap", message="x", stream="sensor", start_s=1, stop_s=2)
    gaps = [replace(gap, episode=f"e{index}") for index in range(4)]
    report = Report("R", "", [], [Section("S", [Issues(gaps, "fine")])])
    line = "warning: gap: sensor · 4 episodes, the first e0 1.00–2.00 s"
    assert list(inspect.summary(report))[2:] == [line, "    x"]
