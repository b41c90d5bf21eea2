"""The whole in one picture: two stages with a store between them, and what one tick sees."""

from drawing import Drawing

from figures.clocks import draw_tick

STREAMS = (
    ("frame", "camera frames"),
    ("sensor", "force, A-scans"),
    ("state", "joints, poses"),
    ("action", "actions"),
)
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
    names = (("vl", "features"), ("sensor", "sensor encoder"), ("state", "state encoder"))
    for index, (colour, name) in enumerate(names):
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


def icon() -> Drawing:
    """The mark of the site: a store."""
    drawing = Drawing(32, 32, "VLA feature cache")
    for y in (8, 16, 24):
        drawing.curve(f"M5 {y}a11 4.5 0 0 0 22 0", "vl", 2.6)
    drawing.curve("M5 8a11 4.5 0 0 1 22 0V24M5 8V24", "vl", 2.6)
    return drawing
