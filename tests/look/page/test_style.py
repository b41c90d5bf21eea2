"""What every picture shares: words as they are written, whatever is in them."""

import warnings

import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.evaluate.sources import TrainingCurve, TrainingCurves
from pipeline.look.evaluation import draw_curves
from pipeline.look.page import style


def test_axes_of_powers_of_ten_say_plain_numbers() -> None:
    steps = np.arange(1, 200)
    loss = TrainingCurve(steps, 10.0 / steps**2)
    (course,) = draw_curves(TrainingCurves({"train/loss": loss}), 1).axes
    course.figure.draw_without_rendering()
    said = [label.get_text() for label in course.get_yticklabels(which="both")]
    assert "0.01" in said
    assert not any("$" in one for one in said)


def test_letters_without_a_font_are_said_once_and_other_warnings_go_on(tmp_path, monkeypatch):
    def drawn() -> Figure:
        figure = style.canvas(2, 1)
        figure.text(0, 0, "바늘 삽입")
        return figure

    monkeypatch.setitem(style.RC, "font.family", ["DejaVu Sans"])
    with pytest.warns(UserWarning) as found:
        style.write(tmp_path, {"one.png": drawn, "two.png": drawn})
    assert [str(one.message) for one in found] == [style.NO_FONT]
    with pytest.warns(UserWarning, match="another"), style.boxes() as said:
        warnings.warn("another", stacklevel=1)
        style.write(tmp_path, {"one.png": lambda: style.canvas(1, 1)})
    assert said == set()


def test_fonts_are_those_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    def here(*names: str) -> None:
        monkeypatch.setattr(style.font_manager, "get_font_names", lambda: list(names))

    here("Comic", "DejaVu Sans", "NanumGothic")
    assert style.families() == ["DejaVu Sans", "NanumGothic"]
    # A font that matplotlib's list does not have yet is added to it.
    here("DejaVu Sans")
    manager, added = style.font_manager.fontManager, list[str]()
    known = manager.ttflist[0].fname
    monkeypatch.setattr(style.font_manager, "findSystemFonts", lambda: [known, "/new.ttc"])
    monkeypatch.setattr(manager, "addfont", added.append)
    assert style.families() == ["DejaVu Sans"]
    assert added == ["/new.ttc"]
