"""Figures of time: clocks and ticks, rows that ticks share, and how old a feature is."""

from dataclasses import dataclass
from random import Random

from drawing import Drawing

STEP_S = 0.1
REUSE = 3
NAMES = (
    ("frame", "frames", "camera, 30 Hz"),
    ("vl", "VL rows", "one for 3 ticks"),
    ("sensor", "sensor", "650 Hz"),
    ("state", "state", "100 Hz"),
    ("action", "action", "10 Hz"),
)


@dataclass(frozen=True)
class TickView:
    """Where on the canvas the lanes lie, and what of them is shown."""

    left: float
    right: float
    top: float
    lane: float = 46
    ticks: int = 20
    now: int = 10
    horizon: int = 8
    window: int = 1
    states: int = 10

    def x(self, tick: float) -> float:
        """Where an instant lies, counted in ticks."""
        return self.left + (self.right - self.left) * (tick + 0.4) / self.ticks

    def y(self, lane: int) -> float:
        """The middle of a lane."""
        return self.top + self.lane * (lane + 0.5)


def tick() -> Drawing:
    """Every clock in a lane of its own, and what one tick takes from each."""
    drawing = Drawing(
        1000,
        312,
        "Lanes of frames, VL rows, readings, states and ticks over time; one tick takes the VL "
        "row that covers it, the windows of readings that end at it, and the actions from it on.",
    )
    draw_tick(drawing, TickView(left=150, right=980, top=36))
    return drawing


def draw_tick(drawing: Drawing, view: TickView) -> None:
    """The lanes of one episode around its tick `now`."""
    bottom = view.y(4) + view.lane / 2
    for lane, (colour, name, rate) in enumerate(NAMES):
        y = view.y(lane)
        drawing.line((view.left, y), (view.right, y), colour="faint", width=1)
        drawing.text(view.left - 14, y - 2, name, colour, anchor="end", bold=True)
        drawing.text(view.left - 14, y + 14, rate, "mute", anchor="end", size=13)
    _frames(drawing, view)
    _rows(drawing, view)
    _readings(drawing, view)
    _actions(drawing, view)
    x = view.x(view.now)
    drawing.line((x, view.top - 6), (x, bottom + 2), width=2)
    drawing.text(x, view.top - 12, "this tick", anchor="middle", bold=True)
    drawing.text(view.right, bottom + 16, "time", "mute", size=13, anchor="end")


def _frames(drawing: Drawing, view: TickView) -> None:
    """Frames at 30 Hz with jitter; the row was computed from the last one at or before its tick."""
    random = Random(4)
    row = view.now // REUSE * REUSE
    seen = -1.0
    times: list[float] = []
    while seen < view.ticks - 1:
        seen += 0.31 + random.uniform(-0.06, 0.08)
        times.append(seen)
    newest = max(time for time in times if time <= row)
    for time in (one for one in times if one > -0.35):
        mine = time == newest
        size = 14.0 if mine else 8.0
        x, y = view.x(time), view.y(0)
        drawing.box(
            x - size / 2, y - size / 2, size, size, "frame", fill=0.9 if mine else 0.12, radius=2
        )
    x = view.x(newest)
    drawing.arrow((x, view.y(0) + 9), (view.x(row) + 12, view.y(1) - 13), colour="frame", width=2)
    drawing.text(
        view.x(view.now) + 10,
        view.y(0) - 10,
        "the last frame at or before the row's tick",
        "mute",
        size=13,
        halo=True,
    )


def _rows(drawing: Drawing, view: TickView) -> None:
    for row in range(0, view.ticks, REUSE):
        mine = row <= view.now < row + REUSE
        begin, end = view.x(row), min(view.x(row + REUSE) - 4, view.right)
        drawing.box(
            begin,
            view.y(1) - 11,
            end - begin,
            22,
            "vl",
            fill=0.5 if mine else 0.1,
            line=2 if mine else 1,
        )
        if end - begin > 60:
            drawing.text(
                (begin + end) / 2, view.y(1) + 5, f"row {row // REUSE}", anchor="middle", size=13
            )


def _readings(drawing: Drawing, view: TickView) -> None:
    """The sensor as a curve, the state as dots; the windows end at the tick."""
    random = Random(2)
    for lane, colour, length in ((2, "sensor", view.window), (3, "state", view.states)):
        y, now = view.y(lane), view.x(view.now)
        begin = view.x(view.now - length)
        drawing.box(begin, y - 16, now - begin, 32, colour, fill=0.22, line=2)
    y, x, level = view.y(2), view.left, 0.0
    points: list[tuple[float, float]] = []
    while x <= view.right:
        level = 0.86 * level + random.gauss(0, 2.2)
        points.append((x, y + max(-8.0, min(11.0, level))))
        x += 2.5
    drawing.line(*points, colour="sensor", width=1)
    x = view.left
    while x <= view.right:
        drawing.dot(x, view.y(3), 1.2, "state")
        x += (view.right - view.left) / view.ticks / 10
    drawing.text(
        view.x(view.now) + 10,
        view.y(2) - 12,
        "the last 65 readings at or before it",
        "mute",
        size=13,
        halo=True,
    )
    drawing.text(
        view.x(view.now) + 10, view.y(3) - 10, "the last 100 states", "mute", size=13, halo=True
    )


def _actions(drawing: Drawing, view: TickView) -> None:
    for tick in range(view.ticks):
        mine = view.now <= tick < view.now + view.horizon
        x, y = view.x(tick), view.y(4)
        if mine:
            drawing.arrow((x, y), (x + 0.8 * (view.x(1) - view.x(0)), y), colour="action", width=3)
        drawing.dot(x, y, 5, "action", fill=1 if mine else 0.1)
    drawing.text(
        view.x(view.now) + 10,
        view.y(4) - 12,
        "what it learns: the chunk of 8 actions from this tick on",
        "mute",
        size=13,
        halo=True,
    )


def reuse() -> Drawing:
    """Ticks, the rows they use, and the frame each row has seen."""
    drawing = Drawing(
        760,
        236,
        "Nine ticks in three groups of three; each group points to one VL row, each row to "
        "one frame of every camera.",
    )
    left, gap = 130.0, 68.0
    for tick_ in range(9):
        x = left + gap * tick_
        row = tick_ // REUSE
        centre = left + gap * (REUSE * row + 1)
        drawing.dot(x, 52, 13, "ink", fill=0.06)
        drawing.text(x, 57, str(tick_), anchor="middle", bold=True)
        drawing.arrow((x, 68), (x if x == centre else x + (centre - x) * 0.62, 104), colour="vl")
    for row in range(3):
        x = left + gap * REUSE * row - 24
        drawing.box(x, 107, 2 * gap + 48, 34, "vl", fill=0.25, line=2)
        drawing.text(x + gap + 24, 129, f"VL row {row}", anchor="middle", bold=True)
        for view in range(3):
            drawing.box(x + 12 + 58 * view, 176, 46, 30, "frame", fill=0.14)
            drawing.text(x + 35 + 58 * view, 195, f"View{view + 1}", anchor="middle", size=12)
            drawing.arrow((x + 35 + 58 * view, 174), (x + 35 + 58 * view, 144), colour="frame")
    for y, name in ((57, "ticks"), (129, "rows"), (195, "frames")):
        drawing.text(20, y, name, "mute", bold=True)
    drawing.text(left - 24, 24, "vlm_reuse_count: 3", "mute", mono=True, size=13)
    drawing.text(
        left - 24,
        228,
        "row j serves the ticks 3j, 3j + 1 and 3j + 2 of its episode",
        "mute",
        size=13,
    )
    return drawing


def age() -> Drawing:
    """Age over time: it grows by a tick a tick, and falls where a new row begins."""
    drawing = Drawing(
        760,
        348,
        "The age of the features at each tick: 0.02, 0.12, 0.22 seconds and again; with a "
        "feature lag of one row, 0.3 seconds more.",
    )
    left, right, floor, unit = 92.0, 640.0, 282.0, 400.0
    step = (right - left) / 12
    for tenths in range(6):
        y = floor - unit * tenths / 10
        drawing.line((left, y), (right, y), colour="faint", width=1)
        drawing.text(left - 12, y + 5, f"{tenths / 10:.1f}", "mute", anchor="end", size=13)
    drawing.text(20, 32, "feature_age [s]", "mute", mono=True, size=13)
    for lag, colour, name in ((0, "vl", "feature_lag 0"), (1, "frame", "feature_lag 1")):
        points: list[tuple[float, float]] = []
        for index in range(12):
            row = max(0, index // REUSE - lag)
            old = (index - REUSE * row) * STEP_S + 0.02
            points.append((left + step * (index + 0.5), floor - unit * old))
        drawing.line(*points, colour=colour, width=1.5, dash="" if lag == 0 else "5 4")
        for index, (x, y) in enumerate(points):
            if lag == 0 or index >= REUSE:
                drawing.dot(x, y, 5, colour, fill=1 if lag == 0 else 0.15)
        drawing.text(right + 8, points[-1][1] + 5, name, colour, size=13, bold=True)
    for index in range(12):
        drawing.text(
            left + step * (index + 0.5), floor + 22, str(index), "mute", anchor="middle", size=13
        )
    for row in range(4):
        x = left + step * REUSE * row
        drawing.box(x + 2, floor + 30, step * REUSE - 4, 22, "vl", fill=0.25)
        drawing.text(x + step * 1.5, floor + 46, f"row {row}", anchor="middle", size=13)
    drawing.text(right + 8, floor + 22, "tick", "mute", size=13)
    drawing.text(
        left + 6, floor - unit * 0.42, "row 0 has none before it", "mute", size=12, halo=True
    )
    return drawing
