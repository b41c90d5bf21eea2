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


def documents() -> dict[str, str]:
    """Every file's name and text.

    The README's figures, one of them for phones, are a file for light and one for dark each:
    GitHub's theme is not the system's.
    """
    files = {f"{name}.svg": draw().svg() for name, draw in DRAWINGS.items()}
    for name, draw in (("pipeline", overview.pipeline), ("narrow", overview.narrow)):
        files[f"{name}-light.svg"] = draw().svg(LIGHT)
        files[f"{name}-dark.svg"] = draw().svg(DARK)
    return files


if __name__ == "__main__":
    for file, text in documents().items():
        (FIGURES / file).write_text(text, encoding="utf-8")
        print(FIGURES / file)
