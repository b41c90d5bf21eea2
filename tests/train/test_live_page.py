"""The live page: what it shows, when it is drawn, and that it needs nothing."""

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from pipeline.train.live_page import MOST_POINTS, REFRESH_S, LivePage, chart, thinned

ROOT = Path(__file__).resolve().parents[2]


class Clock:
    """A clock that stands still unless told, and on which drawing takes `drawing_s`."""

    def __init__(self) -> None:
        self.now, self.drawing_s, self._drawing = 100.0, 0.0, False

    def monotonic(self) -> float:
        return self.now

    def strftime(self, form: str) -> str:
        return f"at second {self.now:.0f}"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("pipeline.train.live_page.time", clock)
    return clock


def page(folder: Path) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


def test_it_draws_itself_again_until_the_run_ends(tmp_path: Path, clock: Clock) -> None:
    live = LivePage(tmp_path, "models/<head>", 500)
    live.write(10, {"train/loss": 0.5, "lr": 1e-4})
    assert f'<meta http-equiv="refresh" content="{REFRESH_S}">' in page(tmp_path)
    assert "step 10 of 500, training. Written at second 100; if that is long" in page(tmp_path)
    live.write(20, {"train/loss": 0.25, "val/error": 0.3, "lr": 1e-4})
    assert "step 10 of 500" in page(tmp_path), "not before it is due"
    clock.now += REFRESH_S
    live.write(30, {"train/loss": 0.2})
    assert "step 30 of 500" in page(tmp_path)
    live.close(finished=True)
    said = page(tmp_path)
    assert "step 30 of 500, finished" in said
    assert "http-equiv" not in said and "at second" not in said, "DVC hashes it"
    assert "models/&lt;head&gt;" in said
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    headings = re.findall(r"<h2>(.*?)</h2>", said)
    assert headings == ["Held-out ticks", "Training", "Schedule"]
    assert "<b>val/error [training std]</b> 0.3 at step 20" in said
    assert "the mean over the steps since the point before it" in said
    assert "what is neither translation" in said


def test_its_colours_are_those_of_the_other_pages(tmp_path: Path) -> None:
    live = LivePage(tmp_path, "head", 10)
    live.close(finished=True)
    css = (ROOT / "pipeline/look/page/templates/page.css").read_text(encoding="utf-8")
    for name in ("paper", "panel", "ink", "soft", "grid", "blue"):
        found = re.search(rf"--{name}: light-dark\((#\w+), (#\w+)\)", css)
        assert found is not None
        for colour in found.groups():
            assert colour in page(tmp_path), f"{name} {colour}"


def test_it_asks_for_nothing_and_the_same_numbers_give_the_same_bytes(tmp_path: Path) -> None:
    written: list[str] = []
    for _ in range(2):
        live = LivePage(tmp_path, "head", 40)
        for step in range(10, 50, 10):
            live.write(step, {"train/loss": 1 / step, "val/error": 2 / step})
        live.close(finished=False)
        written.append(page(tmp_path))
    assert written[0] == written[1]
    assert "stopped before its end; the terminal says why" in written[0]
    assert not re.search(r"https?://|<script|<link|src=", written[0])


def test_drawing_takes_no_more_than_its_share_of_the_time(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[float] = []

    def slow(self: LivePage, *rest: object) -> None:
        drawn.append(clock.now)
        clock.now += 0.5

    monkeypatch.setattr(LivePage, "_save", slow)
    live = LivePage(tmp_path, "head", 10_000)
    began = clock.now
    for step in range(10, 10_000, 10):
        live.write(step, {"train/loss": 1.0})
        clock.now += 1
    assert len(drawn) > 5
    assert 0.5 * (len(drawn) - 1) / (clock.now - began) < 0.0051


def shape(name: str, *points: tuple[int, float]) -> tuple[ET.Element, list[tuple[float, float]]]:
    """The figure, well-formed, and the points of its line in pixels."""
    figure = ET.fromstring(chart(name, points))
    line = figure.find(".//polyline")
    assert line is not None
    return figure, [
        (float(x), float(y)) for x, y in (p.split(",") for p in line.attrib["points"].split())
    ]


def test_a_curve_falls_where_its_values_fall() -> None:
    figure, line = shape("val/error", (10, 0.4), (20, 0.2), (40, 0.3))
    (x0, y0), (x1, y1), (x2, y2) = line
    assert (x1 - x0) * 2 == pytest.approx(x2 - x1, abs=0.2), "steps are an axis, not an order"
    assert y0 < y2 < y1, "down is less"
    mark = figure.find(".//circle")
    assert mark is not None
    assert (float(mark.attrib["cx"]), float(mark.attrib["cy"])) == (x1, y1)
    assert "0.3 at step 40, lowest 0.2 at 20" in "".join(figure.itertext())
    assert [text.text for text in figure.iter("text")][:4] == ["0.2", "0.2667", "0.3333", "0.4"]


def test_a_curve_over_decades_is_logarithmic() -> None:
    figure, line = shape("train/loss", (0, 1.0), (1, 0.1), (2, 0.001), (3, 0.01))
    assert line[1][1] - line[0][1] == pytest.approx(line[3][1] - line[1][1], abs=0.2)
    assert "logarithmic" in "".join(figure.itertext())
    assert [text.text for text in figure.iter("text")][:4] == ["0.001", "0.01", "0.1", "1"]


def test_a_long_curve_is_thinned_to_means() -> None:
    points = thinned([(step, float(step % 2)) for step in range(100_000)])
    assert len(points) <= MOST_POINTS
    assert all(value == pytest.approx(0.5, abs=0.01) for _, value in points)


def test_the_words_of_a_thinned_curve_are_of_its_true_points() -> None:
    points = [(step, 2.0 + math.cos(step)) for step in range(1, 5 * MOST_POINTS)]
    points[702] = (703, 0.001)
    points[-1] = (points[-1][0], 1.75)
    figure, line = shape("val/error", *points)
    assert len(line) <= MOST_POINTS < len(points)
    assert f"1.75 at step {points[-1][0]:,}, lowest 0.001 at 703" in "".join(figure.itertext())


@pytest.mark.parametrize("values", [[0.0], [3.0, 3.0], [-1.0, -1.0], [-1.0, 2.0], [5e-324, 1.0]])
def test_odd_curves_are_drawn(values: list[float]) -> None:
    figure, line = shape("train/loss", *enumerate(values))
    assert len(line) == len(values)
    assert "nan" not in ET.tostring(figure, encoding="unicode")


def test_what_is_not_finite_is_left_out(tmp_path: Path) -> None:
    live = LivePage(tmp_path, "head", 40)
    live.write(1, {"train/loss": math.nan, "lr": math.inf})
    live.write(2, {"train/loss": 0.5})
    live.close(finished=False)
    said = page(tmp_path)
    assert "<b>train/loss</b> 0.5 at step 2<" in said
    assert "<b>lr</b> no finite value yet" in said
