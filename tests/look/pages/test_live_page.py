"""The page of a training that goes on, in a real browser."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.train.live_page import LivePage


@pytest.mark.parametrize(
    ("size", "scheme"), [((1280, 900), "light"), ((390, 844), "dark")], ids=["desktop", "phone"]
)
def test_it_shows_every_curve_and_asks_for_nothing(
    browser_page: Callable[..., Any], tmp_path: Path, size: tuple[int, int], scheme: str
) -> None:
    live = LivePage(tmp_path, "models/" + "x" * 120, 40)
    for step in range(10, 50, 10):
        live.write(step, {"train/loss": 1 / step, "val/error": 2 / step, "lr": 1e-4 * step})
    live.close(finished=True)
    visit = browser_page(tmp_path / "report.html", size, scheme)
    found = visit.page.evaluate(
        """() => ({
          lines: [...document.querySelectorAll("polyline")].map((one) => one.getBBox().width),
          overflow: document.documentElement.scrollWidth - window.innerWidth,
        })"""
    )
    assert visit.trouble == []
    assert found["overflow"] <= 0
    assert len(found["lines"]) == 3
    assert all(width > 200 for width in found["lines"])
