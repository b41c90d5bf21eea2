"""The page as a reader has it: sound at every width, with and without scripts, on paper."""

import json
import time
from pathlib import Path

import pytest


def test_a_browser_finds_every_block_sound(every_page, assert_page_is_sound):
    assert_page_is_sound(every_page)


def test_a_request_and_an_error_are_trouble(every_page, tmp_path, browser_page):
    planted = '<img src="https://example.org/a.png"><script>throw new Error("wrong")</script>'
    text = every_page.read_text(encoding="utf-8")
    page = tmp_path / "a.html"
    page.write_text(text.replace("<main", f"{planted}<main", 1), encoding="utf-8")
    visit = browser_page(page)
    until = time.monotonic() + 30
    while len(visit.trouble) < 2 and time.monotonic() < until:
        visit.page.wait_for_timeout(10)
    for trouble in ("example.org", "wrong"):
        assert trouble in str(visit.trouble)


@pytest.mark.slow
def test_a_picture_opens_large_and_goes_back(every_page: Path, browser_page) -> None:
    page = browser_page(every_page).page
    small = page.locator("#picture-one svg").bounding_box()
    page.locator("#picture-one svg").click()
    large = page.locator("dialog[open] svg").bounding_box()
    assert large["width"] > small["width"]
    page.keyboard.press("Escape")
    # Each is waited for: a browser opens and closes in its own time.
    page.locator("dialog[open]").wait_for(state="detached")
    assert page.locator("#picture-one svg").bounding_box()["width"] == small["width"]
    for key in ("Enter", " "):
        page.get_by_role("button", name="Enlarge: A sine").press(key)
        page.locator("dialog[open] svg").wait_for()
        page.keyboard.press("Escape")
        page.locator("dialog[open]").wait_for(state="detached")


# A browser hands over what it stored in its own time: here the test is what keeps it.
STORAGE = """
const kept = %s;
const storage = { getItem: (key) => kept[key] ?? null, setItem: (key, value) => kept[key] = value };
Object.defineProperty(window, "localStorage", { get: () => { %s return storage; } });
Object.defineProperty(window, "kept", { value: kept });
"""


@pytest.mark.slow
def test_light_and_dark_can_be_chosen_and_are_remembered(every_page, browser_page):
    chosen = "() => document.documentElement.dataset.theme"
    first = browser_page(every_page, script=STORAGE % ("{}", ""))
    first.page.locator("#theme").click()
    kept = first.page.evaluate("() => kept")
    assert kept == {f"theme:{every_page.resolve().as_posix()}": "dark"}
    again = browser_page(every_page, script=STORAGE % (json.dumps(kept), ""))
    assert again.page.evaluate(chosen) == "dark"
    refused = "throw new DOMException('denied', 'SecurityError');"
    unkept = browser_page(every_page, script=STORAGE % ("{}", refused))
    unkept.page.locator("#theme").click()
    assert unkept.page.evaluate(chosen) == "dark", "also where nothing may be stored"
    assert first.trouble == again.trouble == unkept.trouble == []


@pytest.mark.slow
def test_without_scripts_and_on_paper_all_is_there(every_page, browser_page):
    still = browser_page(every_page, java_script_enabled=False).page
    assert still.locator("figure svg").count() == 2
    assert still.locator("#picture-one svg").is_visible()
    drawn = browser_page(every_page, scheme="dark").page
    drawn.emulate_media(media="print")
    # What is folded on a screen cannot be unfolded on paper.
    assert drawn.locator("details.outline pre").bounding_box()["height"] > 20
    assert drawn.pdf()[:5] == b"%PDF-"
