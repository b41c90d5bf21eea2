"""Draws every figure again: `python docs/machinery/draw.py`.

The SVG files in `docs/figures` are kept, so that they show wherever the Markdown does; a test
compares them with what this writes.
"""

import sys
from pathlib import Path

FIGURES = Path(__file__).resolve().parents[1] / "figures"
sys.path.insert(0, str(Path(__file__).resolve().parent))

from drawing import DARK, LIGHT  # noqa: E402
from figures import clocks, features, overview, samples, store  # noqa: E402

DRAWINGS = {
    "pipeline": overview.pipeline,
    "flow": overview.flow,
    "tick": clocks.tick,
    "reuse": clocks.reuse,
    "age": clocks.age,
    "slots": features.slots,
    "identity": features.identity,
    "window": samples.window,
    "layout": store.layout,
    "chunk": store.chunk,
    "icon": overview.icon,
}
IN_BOTH = ("pipeline",)
"""Also as one file for light and one for dark: GitHub's theme is not the system's."""


def documents() -> dict[str, str]:
    """Every file's name and text."""
    files = {f"{name}.svg": draw().svg() for name, draw in DRAWINGS.items()}
    for name in IN_BOTH:
        drawing = DRAWINGS[name]()
        files |= {
            f"{name}-light.svg": drawing.svg(LIGHT),
            f"{name}-dark.svg": drawing.svg(DARK),
        }
    return files


if __name__ == "__main__":
    for file, text in documents().items():
        (FIGURES / file).write_text(text, encoding="utf-8")
        print(FIGURES / file)
