"""The page as a reader has it: sound at every width, with and without scripts, on paper."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.report import PAGE, Report, Section, Text, write_report


def test_a_browser_finds_every_block_sound(
    every_block: Report, tmp_path: Path, assert_page_is_sound: Callable[[Path], None]
) -> None:
    files = write_report(tmp_path, every_block)
    assert [file.name for file in files] == [
        PAGE,
        "one.png",
        "two.png",
        "lanes.png",
        "findings.csv",
    ]
    assert {file.name for file in tmp_path.iterdir()} == {file.name for file in files}
    assert_page_is_sound(tmp_path / PAGE)


def test_an_empty_report_is_a_page(
    tmp_path: Path, assert_page_is_sound: Callable[[Path], None], every_block: Report
) -> None:
    bare = replace(every_block, tiles=(), sections=[Section("Nothing", [])])
    assert_page_is_sound(write_report(tmp_path, bare)[0])


@pytest.mark.parametrize(
    "planted",
    [
        '<img src="https://example.org/a.png">',
        '<script src="b.js"></script>',
        '<iframe src="https://example.org"></iframe>',
        "<script>fetch('https://example.org/a')</script>",
        "<script>throw new Error('no request, but wrong')</script>",
    ],
)
@pytest.mark.parametrize("guarded", [True, False])
def test_a_page_that_asks_for_anything_is_not_sound(
    guarded: bool, planted: str, tmp_path: Path, browser_page: Callable[..., Any]
) -> None:
    sound = Report("Sound", "", sections=[Section("All", [Text("words")])])
    page = write_report(tmp_path, sound)[0]
    assert browser_page(page).trouble == []
    text = page.read_text().replace("<main", f"{planted}<main")
    # Its policy stops each; without one, it is the browser's route that does.
    page.write_text(text if guarded else text.replace("Content-Security-Policy", "x-none"))
    visit = browser_page(page)
    visit.page.wait_for_timeout(100)
    assert visit.trouble


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


def test_a_picture_opens_by_its_keys(
    every_block: Report, tmp_path: Path, browser_page: Callable[..., Any]
) -> None:
    page = browser_page(write_report(tmp_path, every_block)[0]).page
    for key in ("Enter", " "):
        page.get_by_role("button", name="Enlarge: A sine").press(key)
        assert page.locator("dialog[open] svg").count() == 1
        page.keyboard.press("Escape")
        assert page.locator("dialog[open]").count() == 0


INK = "() => getComputedStyle(document.querySelector('.chart text')).fill"
# A browser hands over what it stored in its own time: here the test is what keeps it.
STORAGE = """
const kept = %s;
const storage = { getItem: (key) => kept[key] ?? null, setItem: (key, value) => kept[key] = value };
Object.defineProperty(window, "localStorage", { get: () => { %s return storage; } });
Object.defineProperty(window, "kept", { value: kept });
"""


def test_light_and_dark_can_be_chosen_and_are_remembered(
    every_block: Report, tmp_path: Path, browser_page: Callable[..., Any]
) -> None:
    page = write_report(tmp_path, every_block)[0]
    first = browser_page(page, script=STORAGE % ("{}", ""))
    light = first.page.evaluate(INK)
    first.page.locator("#theme").click()
    first.page.wait_for_function(f"before => ({INK})() !== before", arg=light)
    kept = first.page.evaluate("() => kept")
    assert kept == {f"theme:{page.resolve().as_posix()}": "dark"}
    again = browser_page(page, script=STORAGE % (json.dumps(kept), ""))
    assert again.page.evaluate("() => document.documentElement.dataset.theme") == "dark"
    drawn = "document.querySelector('.chart text') !== null"
    again.page.wait_for_function(f"before => {drawn} && ({INK})() !== before", arg=light)
    assert first.trouble == again.trouble == []


def test_light_and_dark_can_be_chosen_where_nothing_may_be_stored(
    every_block: Report, tmp_path: Path, browser_page: Callable[..., Any]
) -> None:
    refused = "throw new DOMException('denied', 'SecurityError');"
    page = write_report(tmp_path, every_block)[0]
    visit = browser_page(page, script=STORAGE % ("{}", refused))
    for chosen in ("dark", "light"):
        visit.page.locator("#theme").click()
        assert visit.page.evaluate("() => document.documentElement.dataset.theme") == chosen
    assert visit.trouble == []


def test_without_scripts_and_on_paper_a_chart_is_its_picture(
    every_block: Report, tmp_path: Path, browser_page: Callable[..., Any]
) -> None:
    page = write_report(tmp_path, every_block)[0]
    chart, picture = "#picture-lanes .chart", "#picture-lanes .paper svg"
    still = browser_page(page, java_script_enabled=False).page
    assert still.locator("figure svg").count() == 3
    assert still.locator(picture).is_visible() and not still.locator(chart).is_visible()
    drawn = browser_page(page, scheme="dark").page
    assert drawn.locator(chart).is_visible() and not drawn.locator(picture).is_visible()
    drawn.emulate_media(media="print")
    assert drawn.locator(picture).is_visible() and not drawn.locator(chart).is_visible()
    # What is folded on a screen cannot be unfolded on paper.
    assert drawn.locator("details.document pre").bounding_box()["height"] > 20
    assert drawn.pdf()[:5] == b"%PDF-"


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


def test_the_contents_scroll_to_where_the_reader_is(
    tmp_path: Path, browser_page: Callable[..., Any]
) -> None:
    said = [Section(f"Part {index}", [Text("word " * 2000)]) for index in range(60)]
    page = browser_page(write_report(tmp_path, Report("Long", "", sections=said))[0]).page
    page.evaluate("document.getElementById('part-50').scrollIntoView()")
    here = page.locator("nav a[aria-current]", has_text="Part 50")
    here.wait_for()
    box = here.bounding_box()
    assert 0 < box["y"] < 900
