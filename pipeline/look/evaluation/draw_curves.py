"""The course of a training."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.evaluate.curves import TrainingCurve, TrainingCurves
from pipeline.look.page.style import INK, PALETTE, canvas, logarithmic

_PANELS = {
    "train/loss": ("training loss", PALETTE[0], True),
    "val/error": ("held-out error [training std]", PALETTE[5], False),
    "lr": ("learning rate", PALETTE[2], False),
}
"""TrainingCurve -> what its axis says, colour, and whether to draw decades of it logarithmic."""


def curves(found: TrainingCurves, step: int) -> Figure:
    """Loss, held-out error and learning rate over the steps; a line marks the step judged here."""
    shown = [name for name in _PANELS if name in found.curves] or sorted(found.curves)[:3]
    figure = canvas(max(4.2 * len(shown), 8.4), 3.4)
    axes = figure.subplots(1, len(shown), squeeze=False, sharex=True)[0]
    for axis, name in zip(axes, shown, strict=True):
        _panel(axis, name, found.curves[name], step)
    figure.suptitle(f"Course of the training; the checkpoint judged here is of step {step}")
    return figure


def _panel(axis: Axes, name: str, curve: TrainingCurve, step: int) -> None:
    said, colour, by_decades = _PANELS.get(name, (name, PALETTE[4], False))
    few = len(curve.step) <= 30
    axis.plot(curve.step, curve.value, color=colour, marker="o" if few else "", markersize=4)
    axis.axvline(step, color=INK, lw=1, ls="--")
    # Within a decade a logarithmic axis has nothing but odd numbers to show.
    if by_decades and 0 < 10 * curve.value.min() <= curve.value.max():
        logarithmic(axis)
        axis.grid(which="minor", lw=0.4)
    else:
        axis.set_ylim(bottom=min(0.0, float(curve.value.min())))
    axis.set_title(said)
    axis.set_xlabel("step")
