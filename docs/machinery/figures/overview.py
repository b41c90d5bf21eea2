"""The whole in one picture: two stages with a store between them, and what one tick sees."""

from drawing import Drawing

from figures.clocks import draw_tick

STREAMS = (
    ("frame", "camera frames"),
    ("sensor", "force, A-scans"),
    ("state", "joints, poses"),
    ("action", "actions"),
)
ENCODERS = (("vl", "features"), ("sensor", "sensor encoder"), ("state", "state encoder"))
LANES = (96, 142, 188, 234)


def flow() -> Drawing:
    """Recordings to store to head."""
    drawing = Drawing(
        820,
        300,
        "Stage one runs the frozen model once for every three ticks and writes a store with its "
        "features and the raw streams; stage two trains from the store alone.",
    )
    _flow(drawing)
    return drawing


def pipeline() -> Drawing:
    """The flow; below, one tick's frames, windows and action chunk."""
    drawing = Drawing(
        820,
        646,
        "Stage one runs the frozen model once for every three ticks and writes a store; stage two "
        "trains encoders and an action expert from the store. A tick sees a VL row, a window of "
        "sensor readings and of states that end at it, and learns the actions that follow.",
    )
    _flow(drawing)
    drawing.text(10, 336, "What one tick sees", bold=True, size=16)
    draw_tick(drawing, top=364)
    return drawing


def _flow(drawing: Drawing) -> None:
    titles = (
        (10, "Recordings", "four formats"),
        (168, "Stage one: once", "for every 3rd tick"),
        (398, "The store", "zarr, memory-mapped"),
        (574, "Stage two: every step", "no image, no VLM"),
    )
    for x, title, below in titles:
        drawing.text(x, 26, title, bold=True, size=16)
        drawing.text(x, 48, below, "mute")
    for y, (colour, name) in zip(LANES, STREAMS, strict=True):
        drawing.box(10, y - 17, 124, 34, colour, fill=0.14)
        drawing.text(72, y + 5, name, colour, anchor="middle", bold=True)
        drawing.arrow((136, y), (166 if colour == "frame" else 396, y), colour=colour, width=2)
    _stage_one(drawing, LANES[0])
    _store(drawing, 398, 76, 140, 188)
    _stage_two(drawing)


def _stage_one(drawing: Drawing, y: float) -> None:
    drawing.box(168, y - 25, 156, 50, "vl", fill=0.14, line=2)
    drawing.text(246, y - 4, "frozen Qwen2.5-VL", "vl", anchor="middle", bold=True)
    drawing.text(246, y + 15, "layer, norm, pooling", "mute", anchor="middle")
    drawing.arrow((326, y), (396, y), colour="vl", width=2)
    drawing.text(358, y - 9, "features", "vl", anchor="middle")
    drawing.text(246, LANES[2] - 18, "raw streams, as recorded", "mute", anchor="middle")


def _store(drawing: Drawing, left: float, top: float, width: float, height: float) -> None:
    """A drum, and what is in it."""
    lid = f"a{width / 2:g} 16 0 0 1 {width:g} 0"
    drawing.curve(f"M{left:g} {top:g}{lid}a{width / 2:g} 16 0 0 1 {-width:g} 0", width=2)
    drawing.curve(
        f"M{left:g} {top:g}v{height:g}a{width / 2:g} 16 0 0 0 {width:g} 0v{-height:g}", width=2
    )
    said = ["every row has", "a key of what it is", "and a checksum;", "raw streams whole"]
    drawing.text(left + width / 2, top + 62, said, "mute", anchor="middle")
    middle = top + height / 2
    drawing.arrow((left + width + 2, middle), (572, middle), width=2)


def _stage_two(drawing: Drawing) -> None:
    for index, (colour, name) in enumerate(ENCODERS):
        y = 98 + 68 * index
        drawing.box(574, y - 18, 128, 36, colour, fill=0.14)
        drawing.text(638, y + 5, name, colour, anchor="middle", bold=True)
        drawing.arrow((704, y), (716, y))
    drawing.box(718, 80, 28, 172, fill=0.04)
    drawing.text(737, 166, "fusion", anchor="middle", bold=True, turned=True)
    drawing.arrow((748, 166), (758, 166))
    drawing.box(760, 126, 56, 80, "action", fill=0.14, line=2)
    drawing.text(788, 152, ["action", "expert"], "action", anchor="middle", bold=True)
    drawing.text(788, 194, "8 steps", "mute", anchor="middle")
    drawing.arrow((788, 208), (788, 250), colour="action", width=2)
    drawing.text(816, 270, ["checkpoint,", "evaluate"], anchor="end")


def narrow() -> Drawing:
    """The flow from top to bottom, as wide as a phone."""
    drawing = Drawing(
        400,
        604,
        "Stage one runs the frozen model once for every three ticks and writes a store with its "
        "features and the raw streams; stage two trains from the store alone.",
    )
    drawing.text(8, 22, "Recordings", bold=True, size=16)
    drawing.text(392, 22, "four formats", "mute", anchor="end")
    for (colour, name), left, width in zip(
        (
            ("frame", "camera frames"),
            ("sensor", "sensor"),
            ("state", "state"),
            ("action", "action"),
        ),
        (8, 178, 252, 326),
        (160, 68, 68, 66),
        strict=True,
    ):
        _named(drawing, left, 34, width, colour, name)
        end = 88 if colour == "frame" else 244
        drawing.arrow((left + width / 2, 70), (left + width / 2, end), colour=colour, width=2)
    drawing.text(8, 108, "Stage one: once", bold=True, size=16)
    drawing.text(8, 128, "for every 3rd tick", "mute")
    drawing.box(8, 140, 160, 50, "vl", fill=0.14, line=2)
    drawing.text(88, 161, "frozen Qwen2.5-VL", "vl", anchor="middle", bold=True)
    drawing.text(88, 180, "layer, norm, pooling", "mute", anchor="middle")
    drawing.arrow((88, 192), (88, 244), colour="vl", width=2)
    drawing.text(98, 222, "features", "vl")
    drawing.text(286, 160, ["raw streams,", "as recorded"], "mute", anchor="middle", halo=True)
    drawing.box(8, 248, 384, 76, line=2)
    drawing.text(200, 270, "The store", anchor="middle", bold=True, size=16)
    said = ["zarr, memory-mapped; every row has", "a key of what it is and a checksum"]
    drawing.text(200, 292, said, "mute", anchor="middle")
    drawing.arrow((200, 326), (200, 352), width=2)
    drawing.text(8, 372, "Stage two: every step", bold=True, size=16)
    drawing.text(392, 372, "no image, no VLM", "mute", anchor="end")
    for (colour, name), left, width in zip(ENCODERS, (8, 116, 258), (100, 134, 134), strict=True):
        _named(drawing, left, 386, width, colour, name)
        drawing.arrow((left + width / 2, 422), (left + width / 2, 442))
    drawing.box(8, 444, 384, 32, fill=0.04)
    drawing.text(200, 465, "fusion", anchor="middle", bold=True)
    drawing.arrow((200, 478), (200, 500))
    drawing.box(100, 502, 200, 40, "action", fill=0.14, line=2)
    drawing.text(200, 527, "action expert, 8 steps", "action", anchor="middle", bold=True)
    drawing.arrow((200, 544), (200, 574), colour="action", width=2)
    drawing.text(200, 594, "checkpoint, evaluate", anchor="middle")
    return drawing


def _named(drawing: Drawing, left: float, top: float, width: float, colour: str, name: str) -> None:
    drawing.box(left, top, width, 34, colour, fill=0.14)
    drawing.text(left + width / 2, top + 22, name, colour, anchor="middle", bold=True)


def icon() -> Drawing:
    """The mark of the site: a store."""
    drawing = Drawing(32, 32, "VLA feature cache")
    for y in (8, 16, 24):
        drawing.curve(f"M5 {y}a11 4.5 0 0 0 22 0", "vl", 2.6)
    drawing.curve("M5 8a11 4.5 0 0 1 22 0V24M5 8V24", "vl", 2.6)
    return drawing
