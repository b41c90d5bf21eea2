"""The whole in one picture: two stages with a store between them, and what one tick sees."""

from drawing import Drawing

from figures.clocks import TickView, draw_tick

STREAMS = (
    ("frame", "camera frames"),
    ("sensor", "force, A-scans"),
    ("state", "joints, poses"),
    ("action", "actions"),
)
LANE = 42
TOP = 78


def flow() -> Drawing:
    """Recordings to store to head."""
    drawing = Drawing(
        1000,
        296,
        "Stage one runs the frozen model once for every three ticks and writes a store with its "
        "features and the raw streams; stage two trains from the store alone.",
    )
    _flow(drawing)
    return drawing


def pipeline() -> Drawing:
    """The flow; below, one tick's frames, windows and action chunk."""
    drawing = Drawing(
        1000,
        606,
        "Stage one runs the frozen model once for every three ticks and writes a store; stage two "
        "trains encoders and an action expert from the store. A tick sees a VL row, a window of "
        "sensor readings and of states that end at it, and learns the actions that follow.",
    )
    _flow(drawing)
    drawing.text(20, 322, "What one tick sees", bold=True, size=16)
    draw_tick(drawing, TickView(left=150, right=980, top=350))
    return drawing


def _flow(drawing: Drawing) -> None:
    _recordings(drawing)
    _stage_one(drawing)
    _store(drawing)
    _stage_two(drawing)


def _lane(index: int) -> float:
    return TOP + LANE * index + LANE / 2


def _recordings(drawing: Drawing) -> None:
    drawing.text(20, 34, "Recordings", bold=True, size=16)
    drawing.text(20, 56, "four formats", "mute", size=13)
    for index, (colour, name) in enumerate(STREAMS):
        y = _lane(index)
        drawing.box(20, y - 15, 132, 30, colour, fill=0.14)
        drawing.text(86, y + 5, name, colour, anchor="middle", bold=True)


def _stage_one(drawing: Drawing) -> None:
    drawing.text(208, 34, "Stage one: once", bold=True, size=16)
    drawing.text(208, 56, "for every 3rd tick", "mute", size=13)
    drawing.box(208, _lane(0) - 24, 170, 48, "vl", fill=0.14, line=2)
    drawing.text(293, _lane(0) - 3, "frozen Qwen2.5-VL", "vl", anchor="middle", bold=True)
    drawing.text(293, _lane(0) + 15, "layer, norm, pooling", "mute", anchor="middle", size=13)
    drawing.arrow((156, _lane(0)), (206, _lane(0)), colour="frame", width=2)
    drawing.arrow((380, _lane(0)), (452, _lane(0)), colour="vl", width=2)
    drawing.text(415, _lane(0) - 10, "features", "vl", size=13, anchor="middle")
    for index in (1, 2, 3):
        colour = STREAMS[index][0]
        drawing.arrow((156, _lane(index)), (452, _lane(index)), colour=colour, width=2)
    drawing.text(293, _lane(2) - 16, "raw streams, as recorded", "mute", anchor="middle", size=13)


def _store(drawing: Drawing) -> None:
    left, right, top, bottom, bulge = 454.0, 626.0, TOP - 6.0, TOP + 4 * LANE + 6.0, 16.0
    drawing.text(540, 34, "The store", bold=True, size=16, anchor="middle")
    across = (right - left) / 2
    lid = f"M{left:g} {top:g}a{across:g} {bulge:g} 0 0 1 {right - left:g} 0"
    drawing.curve(f"{lid}a{across:g} {bulge:g} 0 0 1 {left - right:g} 0", width=2)
    drawing.curve(
        f"M{left:g} {top:g}V{bottom:g}a{across:g} {bulge:g} 0 0 0 {right - left:g} 0V{top:g}",
        width=2,
    )
    drawing.text(540, 128, "cache_store/*.zarr", mono=True, size=13, anchor="middle")
    drawing.text(540, 164, "every row: a key of what", "mute", size=13, anchor="middle")
    drawing.text(540, 182, "it is, and a checksum", "mute", size=13, anchor="middle")
    drawing.text(540, 218, "mapped into memory", "mute", size=13, anchor="middle")
    drawing.arrow((628, 162), (690, 162), width=2)
    drawing.text(659, 150, "batches", "mute", size=13, anchor="middle")


def _stage_two(drawing: Drawing) -> None:
    drawing.text(694, 34, "Stage two: every step", bold=True, size=16)
    drawing.text(694, 56, "no image, no video, no VLM", "mute", size=13)
    names = (("vl", "features"), ("sensor", "sensor encoder"), ("state", "state encoder"))
    for index, (colour, name) in enumerate(names):
        y = 98 + 64 * index
        drawing.box(694, y - 17, 118, 34, colour, fill=0.14)
        drawing.text(753, y + 5, name, colour, anchor="middle", size=13, bold=True)
        drawing.arrow((814, y), (842, y))
    drawing.box(844, 81, 36, 162, "ink", fill=0.04)
    drawing.text(867, 162, "fusion", anchor="middle", bold=True, turned=True)
    drawing.arrow((882, 162), (902, 162))
    drawing.box(904, 118, 86, 88, "action", fill=0.14, line=2)
    drawing.text(947, 145, "action", "action", anchor="middle", bold=True)
    drawing.text(947, 163, "expert", "action", anchor="middle", bold=True)
    drawing.text(947, 186, "8 actions", "mute", anchor="middle", size=13)
    drawing.arrow((947, 208), (947, 246), colour="action", width=2)
    drawing.text(947, 264, ["checkpoint,", "evaluate"], anchor="middle", size=14)


def icon() -> Drawing:
    """The mark of the site: a store."""
    drawing = Drawing(32, 32, "VLA feature cache")
    for y in (8, 16, 24):
        drawing.curve(f"M5 {y}a11 4.5 0 0 0 22 0", "vl", 2.6)
    drawing.curve("M5 8a11 4.5 0 0 1 22 0V24M5 8V24", "vl", 2.6)
    return drawing
