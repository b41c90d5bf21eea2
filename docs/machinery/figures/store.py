"""Figures of the store: how its arrays point to each other, and how an array lies in files."""

from itertools import pairwise

from drawing import Drawing

LEFT, WIDTH, ENDS = 160.0, 630.0, (0.0, 0.36, 0.71, 1.0)
"""Where the arrays lie, and in them the episodes."""
ARRAYS = (
    (42, "mute", "episode/*_start", "offsets"),
    (132, "action", "tick/*", "time, action"),
    (232, "vl", "vl/*", "features, keys"),
    (300, "sensor", "sensor/*", "values, time"),
    (368, "state", "state/*", "values, time"),
)
FILE, ROWS, BYTES = 266.0, 9, 23.0
"""Chunk files: from one to the next, rows of each, width of a row."""


def layout() -> Drawing:
    """Offsets of an episode, indices of a tick, and the streams that both point into."""
    drawing = Drawing(
        820,
        410,
        "episode/*_start say where each episode begins in every stream; tick/vl_row, "
        "tick/sensor_end and tick/state_end say which row and readings a tick uses.",
    )
    for y, colour, name, what in ARRAYS:
        drawing.text(10, y + 14, name, colour, mono=True, bold=True)
        drawing.text(10, y + 32, what, "mute")
    edges = [LEFT + WIDTH * end for end in ENDS]
    for index, x in enumerate(edges):
        drawing.box(x - 17, 38, 34, 28, "mute", fill=0.1)
        drawing.text(x, 57, f"[{index}]", anchor="middle", mono=True)
        drawing.arrow((x, 68), (x, 130))
        drawing.line((x, 162), (x, 400), colour="mute", width=1, dash="3 4")
    for y, colour, _, _ in ARRAYS[1:]:
        for index, (begin, end) in enumerate(pairwise(edges)):
            fill = 0.18 if index == 1 else 0.08
            drawing.box(begin, y, end - begin, 30, colour, fill=fill, radius=0)
            drawing.text(end - 8, y + 20, f"episode {index}", colour, anchor="end")
    _tick(drawing, LEFT + WIDTH * 0.5)
    return drawing


def _tick(drawing: Drawing, x: float) -> None:
    """One tick, its row, and the last reading of each stream that it sees."""
    drawing.box(x - 9, 132, 18, 30, "action", fill=0.8, radius=0)
    drawing.text(x, 122, "one tick", anchor="middle", bold=True, halo=True)
    drawing.arrow((x - 4, 164), (x - 20, 230), colour="vl", width=2)
    drawing.box(x - 32, 232, 24, 30, "vl", fill=0.8, radius=0)
    drawing.text(x - 32, 204, "vl_row", "vl", mono=True, anchor="end", halo=True)
    for at, y, colour, length in ((x + 2, 300, "sensor", 46), (x + 7, 368, "state", 80)):
        drawing.box(at - length, y, length, 30, colour, fill=0.55, radius=0)
        drawing.arrow((at, 164), (at, y - 1), colour=colour, width=2)
        said = f"{colour}_end: one past the last reading"
        drawing.text(x + 16, y - 11, said, colour, halo=True)


def chunk() -> Drawing:
    """A chunk file: rows from byte 0 on, four bytes behind; files side by side are one range."""
    drawing = Drawing(
        820,
        268,
        "Each chunk file holds whole rows from byte 0 on and a checksum of four bytes behind "
        "them; mapped one after the other the files are one flat array.",
    )
    drawing.text(10, 26, "vl/features on disk", bold=True)
    drawing.text(10, 48, "plain zarr v3: codecs bytes, crc32c", "mute")
    mapped, row = 84.0, 640 / 3 / ROWS
    for index in range(3):
        x, below = 10 + FILE * index, mapped + 640 / 3 * index
        drawing.text(x, 90, f"c/{index}/0/0", mono=True)
        for place in range(ROWS):
            fill = 0.14 + 0.1 * (place % 2)
            drawing.box(x + BYTES * place, 100, BYTES, 34, "vl", fill=fill, line=1, radius=0)
            drawing.box(below + row * place, 196, row, 34, "vl", fill=fill, line=1, radius=0)
        end = x + BYTES * ROWS
        drawing.box(end, 100, 30, 34, "mute", fill=0.5, line=1, radius=0)
        drawing.line((x, 136), (below, 194), colour="faint", width=1)
        drawing.line((end, 136), (below + 640 / 3, 194), colour="faint", width=1)
    drawing.text(14, 156, "byte 0", "mute", halo=True)
    drawing.text(247, 156, "crc32c", "mute", anchor="end", halo=True)
    drawing.text(10, 218, "mapped", bold=True)
    drawing.text(734, 210, ["one array,", "no copy"], "mute")
    said = "a chunk is a multiple of 4,096 rows, so data fill whole pages whatever a row's width"
    drawing.text(84, 256, said, "mute")
    return drawing
