"""One page, whole, safe, the same each time; a browser finds nothing wrong with it."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from pipeline.base.errors import DiskFull, Issue
from pipeline.look.page.blocks import (
    Issues,
    Picture,
    Report,
    Section,
    Text,
    group_issues,
    place_of,
    places_of,
)
from pipeline.look.page.style import GRID, INK, canvas, inline_svg
from pipeline.look.page.writing import MOST_PLACES, PAGE, breakable, prose, write_report


def words(*said: str) -> Report:
    return Report("Words", "", sections=[Section("All", [Text(one) for one in said])])


def pictures(*names: str, draw: Callable[[], Figure] = lambda: canvas(2, 2)) -> Report:
    blocks = [Picture(name, f"The picture {name}.", draw) for name in names]
    return Report("Pictures", "", sections=[Section("All", blocks)])


def test_the_same_report_gives_the_same_bytes(every_block, every_page, tmp_path):
    files = write_report(tmp_path, every_block)
    names = [file.name for file in files]
    assert names == [PAGE, "one.png", "two.png", "findings.csv"]
    assert {file.name for file in tmp_path.iterdir()} == set(names)
    for file in files:
        assert file.read_bytes() == every_page.with_name(file.name).read_bytes(), file.name


def test_what_is_said_cannot_become_markup(every_page: Path) -> None:
    page = every_page.read_text()
    assert "<title>A page &lt;of&gt; every block</title>" in page
    assert "<code>code</code> &amp; &lt;script&gt;alert(1)" in page
    assert "Content-Security-Policy\" content=\"default-src 'none'" in page, "if something could"


def test_pictures_have_no_ink_of_their_own(every_page: Path) -> None:
    svg = re.findall(r"<svg viewBox=.*? role=\"img\".*?</svg>", every_page.read_text(), re.DOTALL)
    assert len(svg) == 2
    for one in svg:
        assert INK not in one and GRID not in one
        assert "#0072b2" not in one.lower()
        for name in ("ink", "grid", "blue"):
            assert f"var(--{name})" in one
        assert 'xlink:href="data:image/png;base64' in one


def test_photographs_are_small_and_maps_are_exact() -> None:
    rng = np.random.default_rng(0)
    coarse = Image.fromarray(rng.integers(0, 255, (8, 8, 3), np.uint8))
    noise = rng.integers(0, 12, (480, 640, 3), np.uint8)
    photograph = np.asarray(coarse.resize((640, 480), Image.Resampling.BICUBIC)) // 2 + noise
    for image, kind in ((photograph, "jpeg"), (np.arange(4800.0).reshape(60, 80), "png")):
        figure = canvas(7, 6)
        figure.subplots().imshow(image)
        svg = inline_svg(figure, "one", "An image.")
        assert f"data:image/{kind};base64" in svg


def test_names_that_are_no_text_are_shown(tmp_path: Path) -> None:
    page = write_report(tmp_path, words("caf\udce9"))[0]
    assert "<p>caf\\udce9</p>" in page.read_text(encoding="utf-8")
    assert page.stat().st_size < 30_000, "a page of words is small"
    assert breakable("/lab/run_1<b>") == "/lab/<wbr>run_<wbr>1&lt;b&gt;"
    assert prose("a `b_c` & <d> `") == "a <code>b_c</code> &amp; &lt;d&gt; `"


def test_pictures_of_an_earlier_page_go_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "mine.png").write_bytes(b"mine")
    write_report(tmp_path, pictures("one", "two"))
    write_report(tmp_path, pictures("two", "three"))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"metrics.json", "mine.png", PAGE, "two.png", "three.png"}


def test_a_page_that_cannot_be_finished_leaves_the_old_one(tmp_path: Path) -> None:
    def broken() -> Figure:
        raise KeyboardInterrupt

    write_report(tmp_path, pictures("one"))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    other = pictures("one", "two", draw=lambda: canvas(5, 5))
    stopped = Report(
        "Stopped", "", sections=[*other.sections, *pictures("x", draw=broken).sections]
    )
    with pytest.raises(KeyboardInterrupt):
        write_report(tmp_path, stopped)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_what_a_kill_left_is_cleared_away(tmp_path: Path) -> None:
    left = tmp_path / f".{PAGE}.new"
    left.mkdir()
    (left / "one.png").write_bytes(b"half")
    write_report(tmp_path, words("whole"))
    assert [path.name for path in tmp_path.iterdir()] == [PAGE]


def test_a_full_disk_keeps_the_old_page(small_disk: Path) -> None:
    write_report(small_disk, words("old"))
    with pytest.raises(DiskFull, match="make room"):
        write_report(small_disk, words("x" * 9_000_000))
    assert "<p>old</p>" in (small_disk / PAGE).read_text()
    assert [path.name for path in small_disk.iterdir()] == [PAGE]


def test_equal_titles_have_anchors_of_their_own(every_page: Path) -> None:
    page = every_page.read_text()
    assert page.count('<section id="words">') == page.count('<section id="words-2">') == 1


def test_every_place_of_a_finding_is_there(tmp_path: Path) -> None:
    count = MOST_PLACES + 40
    gap = Issue(severity="warning", kind="gap", message="", stream="view V")
    gaps = [
        replace(gap, message=f"found {i}", episode=f"e{i}", start_s=float(i), stop_s=float(i + 1))
        for i in range(count)
    ]
    alone = Issue(severity="error", kind="unreadable", message="no `file`", episode="e7")
    found = Issues([*gaps, alone], "fine")
    write_report(tmp_path, Report("R", "", sections=[Section("S", [found])]))
    page = (tmp_path / PAGE).read_text()
    assert "e0 0.00–1.00 s; e1 1.00–2.00 s; e2 2.00–3.00 s; and 337 more" in page
    for index in range(MOST_PLACES):
        assert f'<span class="where">{place_of(gaps[index])}</span> found {index}</li>' in page
    assert f"found {MOST_PLACES}<" not in page
    assert page.count('<details class="places">') == 1
    table = (tmp_path / "findings.csv").read_text().splitlines()
    assert table[:2] == [
        "severity,kind,stream,episode,start_s,stop_s,message",
        "error,unreadable,,e7,,,no `file`",
    ]
    last = count - 1
    assert table[-1] == f"warning,gap,view V,e{last},{last}.000,{count}.000,found {last}"
    assert len(table) == count + 2


def test_the_same_issue_is_told_once_the_worst_first() -> None:
    def issue(kind: str, source: str, episode: str, start_s: float | None = None) -> Issue:
        severity = "error" if kind == "unreadable" else "warning"
        named = {"source": source, "episode": episode, "stream": "sensor", "start_s": start_s}
        return Issue(severity=severity, kind=kind, message=f"{kind} of {episode}", **named)  # type: ignore[arg-type]

    issues = [
        *(issue("rate", "a", "e0"), issue("gap", "a", "e1", 1.0), issue("gap", "a", "e1", 2.0)),
        *(issue("gap", "b", "e1", 2.0), issue("unreadable", "b", "e4", 0.5)),
    ]
    error, gap, rate = group_issues(issues)
    assert (error[0].kind, places_of(error)) == ("unreadable", "sensor · b/e4 0.50 s")
    assert (gap[0].kind, places_of(gap)) == ("gap", "sensor · 3 places in 2 episodes")
    assert [place_of(issue) for issue in gap] == ["a/e1 1.00 s", "a/e1 2.00 s", "b/e1 2.00 s"]
    assert places_of(rate) == "sensor · a/e0"
    (alone,) = group_issues(issues[:1])
    assert places_of(alone) == "sensor · e0"
