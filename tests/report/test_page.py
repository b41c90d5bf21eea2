"""One page, whole, safe, the same each time; a browser finds nothing wrong with it."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from pipeline.errors import DiskFull
from pipeline.plots.style import GRID, INK, canvas
from pipeline.report import PAGE, Picture, Report, Section, Text, write_report
from pipeline.report.cells import columns_of, number
from pipeline.report.page import document_lines
from pipeline.report.svg import inline_svg


def words(*said: str) -> Report:
    return Report("Words", "", sections=[Section("All", [Text(one) for one in said])])


def pictures(*names: str, draw: Callable[[], Figure] = lambda: canvas(2, 2)) -> Report:
    blocks = [Picture(name, f"The picture {name}.", draw) for name in names]
    return Report("Pictures", "", sections=[Section("All", blocks)])


def test_a_browser_finds_every_block_sound(
    every_block: Report, tmp_path: Path, assert_page_is_sound: Callable[[Path], None]
) -> None:
    files = write_report(tmp_path, every_block)
    assert [file.name for file in files] == [PAGE, "one.png", "two.png", "lanes.png"]
    assert {file.name for file in tmp_path.iterdir()} == {file.name for file in files}
    assert_page_is_sound(tmp_path / PAGE)


def test_the_same_report_gives_the_same_bytes(every_block: Report, tmp_path: Path) -> None:
    first = {path.name: path.read_bytes() for path in write_report(tmp_path / "a", every_block)}
    again = {path.name: path.read_bytes() for path in write_report(tmp_path / "b", every_block)}
    assert first == again


def test_what_is_said_cannot_become_markup(every_block: Report, tmp_path: Path) -> None:
    write_report(tmp_path, every_block)
    page = (tmp_path / PAGE).read_text()
    assert "<title>A page &lt;of&gt; every block</title>" in page
    assert "<code>code</code> &amp; &lt;script&gt;alert(1)" in page
    assert "\\u003c/script>\\u003cb>" in page


def test_pictures_have_no_ink_of_their_own(every_block: Report, tmp_path: Path) -> None:
    write_report(tmp_path, every_block)
    svg = re.findall(
        r"<svg viewBox=.*? role=\"img\".*?</svg>", (tmp_path / PAGE).read_text(), re.DOTALL
    )
    assert len(svg) == 3
    for one in svg:
        assert INK not in one and GRID not in one
        assert "currentColor" in one and "var(--grid)" in one
        assert "#0072b2" in one
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


def test_plotly_is_there_once_and_only_for_charts(every_block: Report, tmp_path: Path) -> None:
    write_report(tmp_path, every_block)
    assert (tmp_path / PAGE).read_text().count("plotly.js v") == 1
    write_report(tmp_path, words("no chart"))
    page = (tmp_path / PAGE).read_text()
    assert "lotly" not in page and len(page) < 40_000


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


def test_names_of_pictures_are_file_stems_each_once(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="twice"):
        write_report(tmp_path, pictures("one", "one"))
    with pytest.raises(ValueError, match="plain file stem"):
        write_report(tmp_path, pictures("../one"))


def test_equal_titles_have_anchors_of_their_own(every_block: Report, tmp_path: Path) -> None:
    write_report(tmp_path, every_block)
    page = (tmp_path / PAGE).read_text()
    assert page.count('<section id="words">') == page.count('<section id="words-2">') == 1


def test_a_picture_opens_large_and_goes_back(
    every_block: Report, tmp_path: Path, browser_page
) -> None:
    write_report(tmp_path, every_block)
    page = browser_page(tmp_path / PAGE).page
    small = page.locator("#picture-one svg").bounding_box()
    page.locator("#picture-one svg").click()
    large = page.locator("dialog[open] svg").bounding_box()
    assert large["width"] > small["width"]
    page.keyboard.press("Escape")
    assert page.locator("#picture-one svg").bounding_box()["width"] == small["width"]
    assert page.locator("dialog[open]").count() == 0


def test_light_and_dark_can_be_chosen_and_are_remembered(
    every_block: Report, tmp_path: Path, browser_page
) -> None:
    write_report(tmp_path, every_block)
    visit = browser_page(tmp_path / PAGE, scheme="light")
    ink = "() => getComputedStyle(document.querySelector('.chart text')).fill"
    light = visit.page.evaluate(ink)
    visit.page.locator("#theme").click()
    visit.page.wait_for_function(f"before => ({ink})() !== before", arg=light)
    visit.page.reload()
    assert visit.page.evaluate("() => document.documentElement.dataset.theme") == "dark"
    assert visit.page.evaluate(ink) != light
    assert visit.trouble == []


def test_without_scripts_all_is_there_and_charts_are_pictures(
    every_block: Report, tmp_path: Path, browser_page
) -> None:
    write_report(tmp_path, every_block)
    page = browser_page(tmp_path / PAGE, java_script_enabled=False).page
    assert page.locator("figure svg").count() == 3
    assert page.locator("#picture-lanes svg").bounding_box()["height"] > 100


def test_the_contents_are_folded_on_a_phone_only(
    every_block: Report, tmp_path: Path, browser_page
) -> None:
    write_report(tmp_path, every_block)
    assert browser_page(tmp_path / PAGE).page.locator("nav a").first.is_visible()
    phone = browser_page(tmp_path / PAGE, (390, 844)).page
    assert not phone.locator("nav a").first.is_visible()
    phone.locator("nav summary").click()
    phone.locator("nav a", has_text="Prompt").click()
    assert phone.evaluate("() => location.hash") == "#prompt"
    assert not phone.locator("nav a").first.is_visible()


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0, "0"),
        (1.23456, "1.235"),
        (9.99996, "10.00"),
        (-0.012345, "-0.01235"),
        (12345.678, "12,346"),
        (1234567.8, "1,234,568"),
        (3.2e-7, "3.200e-07"),
        (float("nan"), "–"),
        (float("-inf"), "-∞"),
    ],
)
def test_numbers_have_the_digits_they_deserve(value: float, said: str) -> None:
    assert number(value) == said


def test_columns_know_whether_they_are_numbers() -> None:
    rows = [[1.0, 2.5, "x", True, None], [float("nan"), 7, 3.14159, False, None]]
    whole, mixed, words, flags, empty = columns_of(list("abcde"), rows)
    assert (whole.numeric, whole.cells) == (True, ("1", "–"))
    assert (mixed.numeric, mixed.cells) == (True, ("2.500", "7"))
    assert (words.numeric, words.cells) == (False, ("x", "3.142"))
    assert (flags.numeric, flags.cells) == (False, ("yes", "no"))
    assert (empty.numeric, empty.cells) == (False, ("–", "–"))
    with pytest.raises(ValueError, match="row 1: 1 cells under 2 heads"):
        columns_of(["a", "b"], [[1, 2], [1]])


def test_documents_keep_their_order_and_depth() -> None:
    content = {"b": 1, "a": {"list": [1, 2], "text": "x\ny"}, "slots": [{"layer": -1}], "no": {}}
    assert document_lines(content) == [
        (0, "b", "1"),
        (0, "a", ""),
        (1, "list", "[1, 2]"),
        (1, "text", '"x\\ny"'),
        (0, "slots", ""),
        (1, "-", ""),
        (2, "layer", "-1"),
        (0, "no", "{}"),
    ]


def test_an_empty_report_is_a_page(
    tmp_path: Path, assert_page_is_sound: Callable[[Path], None], every_block: Report
) -> None:
    bare = replace(every_block, tiles=(), sections=[Section("Nothing", [])])
    assert_page_is_sound(write_report(tmp_path, bare)[0])
