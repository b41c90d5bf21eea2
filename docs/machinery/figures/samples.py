"""Figure of a sample: windows that end at a tick, chunks that begin there."""

from drawing import Drawing

EPISODE_TICKS = 12
HORIZON = 5
WINDOW = 3
CASES = (
    (1, "near the start", "zeros before the episode; sensor_valid counts the real readings"),
    (5, "in the middle", "everything is there"),
    (10, "near the end", "past the episode: the last action again, action_valid false, no loss"),
)
LEFT, STEP = 190.0, 40.0


def window() -> Drawing:
    """Three ticks of one episode: padded on the left, whole, masked on the right."""
    drawing = Drawing(
        820,
        424,
        "Windows of readings end at their tick and are padded with zeros on the left; chunks of "
        "actions begin at their tick and are masked past the episode's end.",
    )
    width = STEP * (EPISODE_TICKS + 0.5) + 2
    drawing.box(LEFT, 34, width, 380, "mute", fill=0.05, line=1, dash="2 3", radius=0)
    drawing.text(LEFT + width / 2, 24, "one episode", "mute", anchor="middle")
    for row, (tick, name, said) in enumerate(CASES):
        y = 86 + 122 * row
        drawing.text(10, y - 2, name, bold=True)
        drawing.text(10, y + 18, f"tick {tick}", "mute")
        _readings(drawing, tick, y)
        _actions(drawing, tick, y)
        drawing.line((_x(tick), y - 30), (_x(tick), y + 30), width=2.5)
        drawing.text(LEFT + 8, y + 56, said, "mute", halo=True)
    return drawing


def _x(tick: float) -> float:
    return LEFT + STEP * (tick + 0.5)


def _readings(drawing: Drawing, tick: int, y: float) -> None:
    """The window that ends at a tick, hatched where it begins before the episode."""
    now, first = _x(tick), _x(tick - WINDOW)
    real = max(first, LEFT)
    if first < LEFT:
        drawing.hatch(first, y - 18, LEFT - first, 36)
        drawing.text((first + LEFT) / 2, y + 36, "zeros", "mute", anchor="middle")
    drawing.box(real, y - 18, now - real, 36, "sensor", fill=0.25, line=2, radius=2)
    if first >= LEFT:
        drawing.text((real + now) / 2, y + 5, "readings", "sensor", anchor="middle", bold=True)


def _actions(drawing: Drawing, tick: int, y: float) -> None:
    """The chunk that begins at a tick, hatched where it runs past the episode."""
    for ahead in range(tick, tick + HORIZON):
        x = _x(ahead) + 4
        if ahead < EPISODE_TICKS:
            drawing.box(x, y - 14, STEP - 8, 28, "action", fill=0.3)
        else:
            drawing.hatch(x, y - 14, STEP - 8, 28)
        name = f"a{min(ahead, EPISODE_TICKS - 1)}"
        drawing.text(x + STEP / 2 - 4, y + 5, name, anchor="middle", halo=ahead >= EPISODE_TICKS)
