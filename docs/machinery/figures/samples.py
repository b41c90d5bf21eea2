"""Figure of a sample: windows that end at a tick, chunks that begin there."""

from drawing import Drawing

EPISODE_TICKS = 12
HORIZON = 5
WINDOW = 3
CASES = (
    (
        1,
        "near the start",
        "it begins before the episode: zeros, and sensor_valid counts the real readings",
    ),
    (5, "in the middle", "everything is there"),
    (
        10,
        "near the end",
        "the chunk runs past the episode: the last action again, action_valid false, no loss",
    ),
)


def window() -> Drawing:
    """Three ticks of one episode: padded on the left, whole, masked on the right."""
    drawing = Drawing(
        980,
        440,
        "Windows of readings end at their tick and are padded with zeros on the left; chunks of "
        "actions begin at their tick and are masked past the episode's end.",
    )
    left, step = 210.0, 46.0
    begin, end = left, left + step * (EPISODE_TICKS + 0.5) + 2
    drawing.box(begin, 44, end - begin, 366, "mute", fill=0.05, line=1, dash="2 3", radius=0)
    drawing.text((begin + end) / 2, 32, "one episode", "mute", anchor="middle")
    for row, (tick, name, said) in enumerate(CASES):
        y = 92 + 122 * row
        now = left + step * (tick + 0.5)
        drawing.text(20, y + 6, name, bold=True)
        drawing.text(20, y + 26, f"tick {tick}", "mute", size=13)
        first = now - step * WINDOW
        if first < begin:
            drawing.hatch(first, y - 18, begin - first, 36)
            drawing.text((first + begin) / 2, y + 34, "zeros", "mute", size=12, anchor="middle")
        real = max(first, begin)
        drawing.box(real, y - 18, now - real, 36, "sensor", fill=0.25, line=2, radius=2)
        if now - real > 80:
            drawing.text(
                (real + now) / 2, y + 5, "readings", "sensor", anchor="middle", size=13, bold=True
            )
        for ahead in range(HORIZON):
            x = left + step * (tick + ahead + 0.5)
            inside = tick + ahead < EPISODE_TICKS
            if inside:
                drawing.box(x + 4, y - 14, step - 8, 28, "action", fill=0.3, line=1.5)
                drawing.text(x + step / 2, y + 5, f"a{tick + ahead}", anchor="middle", size=13)
            else:
                drawing.hatch(x + 4, y - 14, step - 8, 28)
                drawing.text(
                    x + step / 2,
                    y + 5,
                    f"a{EPISODE_TICKS - 1}",
                    "mute",
                    anchor="middle",
                    size=13,
                    halo=True,
                )
        drawing.line((now, y - 30), (now, y + 30), width=2.5)
        drawing.text(begin + 8, y + 60, said, "mute", size=13, halo=True)
    return drawing
