"""Figures of time: clocks and ticks, rows that ticks share, and how old a feature is."""

from random import Random

from drawing import Drawing, Point

REUSE = 3
STEP_S = 0.1
LEFT, RIGHT, LANE = 124.0, 810.0, 52.0
TICKS, NOW, HORIZON, STATE_WINDOW = 19, 10, 8, 10
"""What the lanes of an episode show, counted in ticks."""
NAMES = (
    ("frame", "frames", "camera, 30 Hz"),
    ("vl", "VL rows", "one for 3 ticks"),
    ("sensor", "sensor", "650 Hz"),
    ("state", "state", "100 Hz"),
    ("action", "action", "10 Hz"),
)


def tick() -> Drawing:
    """Every clock in a lane of its own, and what one tick takes from each."""
    drawing = Drawing(
        820,
        320,
        "Lanes of frames, VL rows, readings, states and ticks over time; one tick takes the VL "
        "row that covers it, the windows of readings that end at it, and the actions from it on.",
    )
    draw_tick(drawing, top=36)
    return drawing


def draw_tick(drawing: Drawing, top: float) -> None:
    """The lanes of one episode around its tick `NOW`."""
    lanes = [top + LANE * (lane + 0.5) for lane in range(len(NAMES))]
    for y, (colour, name, rate) in zip(lanes, NAMES, strict=True):
        drawing.line((LEFT, y), (RIGHT, y), colour="faint", width=1)
        drawing.text(LEFT - 14, y - 3, name, colour, anchor="end", bold=True)
        drawing.text(LEFT - 14, y + 15, rate, "mute", anchor="end")
    frames, rows, sensor, state, action = lanes
    _frames(drawing, frames, rows)
    _rows(drawing, rows)
    _readings(drawing, sensor, state)
    _actions(drawing, action)
    now, bottom = _x(NOW), top + LANE * len(NAMES)
    drawing.line((now, top - 6), (now, bottom + 2), width=2)
    drawing.text(now, top - 12, "this tick", anchor="middle", bold=True)
    drawing.text(RIGHT, bottom + 18, "time", "mute", anchor="end")
    for y, said in (
        (frames, "the last frame at or before the row's tick"),
        (sensor, "the last 65 readings at or before it"),
        (state, "the last 100 states"),
        (action, "what it learns: the 8 actions from here on"),
    ):
        drawing.text(now + 10, y - 13, said, "mute", halo=True)


def _x(tick: float) -> float:
    """Where an instant lies, counted in ticks."""
    return LEFT + (RIGHT - LEFT) * (tick + 0.4) / TICKS


def _frames(drawing: Drawing, y: float, rows: float) -> None:
    """Frames at 30 Hz with jitter; the row was computed from the last one at or before its tick."""
    random = Random(4)
    row = NOW // REUSE * REUSE
    times = [-0.3]
    while times[-1] < TICKS - 1:
        times.append(times[-1] + 0.31 + random.uniform(-0.06, 0.08))
    newest = max(time for time in times if time <= row)
    for time in times:
        size, fill = (14.0, 0.9) if time == newest else (8.0, 0.12)
        drawing.box(_x(time) - size / 2, y - size / 2, size, size, "frame", fill=fill, radius=2)
    drawing.arrow((_x(newest), y + 9), (_x(row) + 12, rows - 14), colour="frame", width=2)


def _rows(drawing: Drawing, y: float) -> None:
    for row in range(0, TICKS, REUSE):
        mine = row <= NOW < row + REUSE
        begin, end = _x(row), min(_x(row + REUSE) - 4, RIGHT)
        fill, line = (0.5, 2) if mine else (0.1, 1)
        drawing.box(begin, y - 12, end - begin, 24, "vl", fill=fill, line=line)
        if end - begin > 60:
            drawing.text(begin + 8, y + 5, f"row {row // REUSE}")


def _readings(drawing: Drawing, sensor: float, state: float) -> None:
    """The sensor as a curve, the state as dots; the windows end at the tick."""
    for y, colour, length in ((sensor, "sensor", 1), (state, "state", STATE_WINDOW)):
        begin = _x(NOW - length)
        drawing.box(begin, y - 17, _x(NOW) - begin, 34, colour, fill=0.22, line=2)
    random, level = Random(2), 0.0
    points: list[Point] = []
    for place in range(round((RIGHT - LEFT) / 2.5)):
        level = 0.86 * level + random.gauss(0, 2.2)
        points.append((LEFT + 2.5 * place, sensor + max(-8.0, min(11.0, level))))
    drawing.line(*points, colour="sensor", width=1)
    for tenth in range(10 * TICKS):
        drawing.dot(LEFT + (RIGHT - LEFT) * tenth / TICKS / 10, state, 1.2, "state")


def _actions(drawing: Drawing, y: float) -> None:
    for tick in range(TICKS):
        mine = NOW <= tick < NOW + HORIZON
        if mine:
            drawing.arrow((_x(tick), y), (_x(tick + 0.8), y), colour="action", width=3)
        drawing.dot(_x(tick), y, 5, "action", fill=1 if mine else 0.1)


def reuse() -> Drawing:
    """Ticks, the rows they use, and the frame each row has seen."""
    drawing = Drawing(
        760,
        244,
        "Nine ticks in three groups of three; each group points to one VL row, each row to "
        "one frame of every camera.",
    )
    left, gap = 130.0, 68.0
    for tick in range(9):
        x = left + gap * tick
        centre = left + gap * (tick // REUSE * REUSE + 1)
        drawing.dot(x, 52, 13, "ink", fill=0.06)
        drawing.text(x, 57, str(tick), anchor="middle", bold=True)
        drawing.arrow((x, 68), (x + (centre - x) * 0.62, 104), colour="vl")
    for row in range(3):
        x = left + gap * REUSE * row - 24
        drawing.box(x, 107, 2 * gap + 48, 34, "vl", fill=0.25, line=2)
        drawing.text(x + gap + 24, 129, f"VL row {row}", anchor="middle", bold=True)
        for view in range(3):
            middle = x + 35 + 58 * view
            drawing.box(middle - 26, 176, 52, 30, "frame", fill=0.14)
            drawing.text(middle, 196, f"View{view + 1}", anchor="middle")
            drawing.arrow((middle, 174), (middle, 144), colour="frame")
    for y, name in ((57, "ticks"), (129, "rows"), (196, "frames")):
        drawing.text(20, y, name, "mute", bold=True)
    drawing.text(left - 24, 24, "vlm_reuse_count: 3", "mute", mono=True)
    said = "row j serves the ticks 3j, 3j + 1 and 3j + 2 of its episode"
    drawing.text(left - 24, 234, said, "mute")
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
        drawing.text(left - 12, y + 5, f"{tenths / 10:.1f}", "mute", anchor="end")
    drawing.text(20, 32, "feature_age [s]", "mute", mono=True)
    for lag, colour, dash in ((0, "vl", ""), (1, "frame", "5 4")):
        points: list[Point] = []
        for index in range(12):
            row = max(0, index // REUSE - lag)
            old = (index - REUSE * row) * STEP_S + 0.02
            points.append((left + step * (index + 0.5), floor - unit * old))
        drawing.line(*points, colour=colour, dash=dash)
        for x, y in points if lag == 0 else points[REUSE:]:
            drawing.dot(x, y, 5, colour, fill=0.15 if lag else 1)
        drawing.text(right + 8, points[-1][1] + 5, f"feature_lag {lag}", colour, bold=True)
    for index in range(12):
        drawing.text(left + step * (index + 0.5), floor + 22, str(index), "mute", anchor="middle")
    for row in range(4):
        x = left + step * REUSE * row
        drawing.box(x + 2, floor + 30, step * REUSE - 4, 24, "vl", fill=0.25)
        drawing.text(x + step * 1.5, floor + 47, f"row {row}", anchor="middle")
    drawing.text(right + 8, floor + 22, "tick", "mute")
    drawing.text(left + 6, floor - unit * 0.42, "row 0 has none before it", "mute", halo=True)
    return drawing
