"""Figures of the store: how its arrays point to each other, and how an array lies in files."""

from drawing import Drawing


def layout() -> Drawing:
    """Offsets of an episode, indices of a tick, and the streams that both point into."""
    drawing = Drawing(
        980,
        420,
        "episode/*_start say where each episode begins in every stream; tick/vl_row, "
        "tick/sensor_end and tick/state_end say which row and readings a tick uses.",
    )
    left, width = 190.0, 760.0
    ends = (0.0, 0.36, 0.71, 1.0)
    rows = (
        (42, "mute", "episode/*_start", "offsets"),
        (132, "action", "tick/*", "time, action"),
        (232, "vl", "vl/*", "features, keys"),
        (296, "sensor", "sensor/*", "values, time"),
        (360, "state", "state/*", "values, time"),
    )
    for y, colour, name, what in rows:
        drawing.text(20, y + 14, name, colour, mono=True, bold=True)
        drawing.text(20, y + 32, what, "mute", size=12)
        if colour == "mute":
            continue
        for index in range(3):
            begin, end = left + width * ends[index], left + width * ends[index + 1]
            drawing.box(begin, y, end - begin, 30, colour, fill=0.08 + 0.1 * (index == 1), radius=0)
            drawing.text(end - 8, y + 20, f"episode {index}", colour, size=12, anchor="end")
    for index, end in enumerate(ends):
        x = left + width * end
        drawing.box(x - 17, 38, 34, 28, "mute", fill=0.1)
        drawing.text(x, 57, f"[{index}]", anchor="middle", mono=True, size=13)
        drawing.arrow((x, 68), (x, 130))
        drawing.line((x, 162), (x, 392), colour="mute", width=1, dash="3 4")
    _tick(drawing, left + width * 0.5)
    return drawing


def _tick(drawing: Drawing, x: float) -> None:
    drawing.box(x - 9, 132, 18, 30, "action", fill=0.8, radius=0)
    drawing.text(x, 122, "one tick", anchor="middle", bold=True, halo=True)
    drawing.arrow((x, 164), (x - 20, 230), colour="vl", width=2)
    drawing.box(x - 32, 232, 24, 30, "vl", fill=0.8, radius=0)
    drawing.text(x - 32, 204, "vl_row", "vl", mono=True, size=13, anchor="end", halo=True)
    for y, colour, name, length in (
        (296, "sensor", "sensor_end", 46),
        (360, "state", "state_end", 80),
    ):
        drawing.box(x - length, y, length, 30, colour, fill=0.55, radius=0)
        drawing.arrow(
            (x + 5, 164 if y == 296 else 330),
            (x + 3, y - 1),
            colour=colour,
            width=2,
        )
        drawing.text(
            x + 14,
            y - 9,
            f"{name}: one past the last reading",
            colour,
            mono=True,
            size=12,
            halo=True,
        )
    drawing.line((x + 5, 164), (x + 4, 358), colour="state", width=1, dash="3 3")


def chunk() -> Drawing:
    """A chunk file: rows from byte 0 on, four bytes behind; files side by side are one range."""
    drawing = Drawing(
        980,
        268,
        "Each chunk file holds whole rows from byte 0 on and a checksum of four bytes behind "
        "them; mapped one after the other the files are one flat array.",
    )
    drawing.text(20, 34, "vl/features on disk", bold=True)
    drawing.text(20, 54, "plain zarr v3: codecs bytes, crc32c", "mute", size=13)
    for index in range(3):
        x = 20 + 318 * index
        drawing.text(x, 92, f"c/{index}/0/0", mono=True, size=13)
        for row in range(9):
            drawing.box(
                x + 28 * row, 102, 28, 34, "vl", fill=0.14 + 0.1 * (row % 2), line=1, radius=0
            )
        drawing.box(x + 252, 102, 30, 34, "mute", fill=0.5, line=1, radius=0)
        drawing.line((x, 138), (92 + 242 * index, 196), colour="faint", width=1)
        drawing.line((x + 252, 138), (92 + 242 * (index + 1), 196), colour="faint", width=1)
    drawing.text(20, 156, "byte 0", "mute", size=12)
    drawing.text(302, 156, "crc32c", "mute", size=12, anchor="end")
    for row in range(27):
        x = 92 + 726 / 27 * row
        drawing.box(x, 198, 726 / 27, 34, "vl", fill=0.14 + 0.1 * (row % 9 % 2), line=1, radius=0)
    drawing.text(20, 220, "mapped", bold=True, size=13)
    drawing.text(832, 214, ["one array,", "no copy"], "mute", size=13)
    drawing.text(
        92,
        256,
        "a chunk is a multiple of 4,096 rows, so data fill whole pages whatever a row's width",
        "mute",
        size=13,
    )
    return drawing
