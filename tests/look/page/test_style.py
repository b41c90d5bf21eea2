"""What every picture shares: words as they are written, whatever is in them."""

import numpy as np

from pipeline.evaluate.sources import TrainingCurve, TrainingCurves
from pipeline.look.evaluation import draw_curves


def test_axes_of_powers_of_ten_say_plain_numbers() -> None:
    steps = np.arange(1, 200)
    loss = TrainingCurve(steps, 10.0 / steps**2)
    (course,) = draw_curves(TrainingCurves({"train/loss": loss}), 1).axes
    course.figure.draw_without_rendering()
    said = [label.get_text() for label in course.get_yticklabels(which="both")]
    assert "0.01" in said
    assert not any("$" in one for one in said)
