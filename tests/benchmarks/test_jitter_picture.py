"""Pictures of a robot's loop."""

from pathlib import Path

import numpy as np

from benchmarks.jitter_picture import jitter, worst
from pipeline.look.page.style import write
from pipeline.robot.run_report import Timings


def run(rows: int, seed: int) -> tuple[float, Timings]:
    timings = Timings(("late", "act", "tick"), 1000)
    for row in np.random.default_rng(seed).lognormal(0, 1, (rows, 3)):
        timings.note(row)
    return 10.0, timings


def test_no_late_tick_is_lost_among_many() -> None:
    values = np.zeros(60_000)
    values[31_234] = 7.0
    when, shown = worst(np.arange(60_000) / 6000, values)
    assert len(shown) == 240 and shown.max() == 7
    assert abs(when[shown.argmax()] - 31_234 / 6000) < 10 / 240


def test_runs_are_drawn_also_where_one_is_empty(tmp_path: Path) -> None:
    runs = {"one process, 10 Hz": run(500, 0), "nothing": run(0, 1)}
    (path,) = write(tmp_path, {"jitter.png": lambda: jitter(runs)})
    assert path.stat().st_size > 20_000
    written = path.read_bytes()
    write(tmp_path, {"jitter.png": lambda: jitter(runs)})
    assert path.read_bytes() == written
