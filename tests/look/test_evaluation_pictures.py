"""Pictures are written for any shape of data, whole, and the same for the same numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.evaluate.baselines import BASELINES
from pipeline.look import evaluation as plots
from pipeline.look.page.style import write
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison, compare

Drawn = tuple[Comparison, Predictions, SimpleNamespace]


def evaluated(
    episodes: int, dimensions: int = 5, ticks: int = 12, constant: int = 1, horizon: int = 3
) -> Drawn:
    """`constant` dimensions at the end never vary."""
    rng = np.random.default_rng(0)
    action = rng.normal(size=(episodes * ticks, dimensions)).astype(np.float32)
    action[:, dimensions - constant :] = 1
    tick = np.arange(episodes * ticks)
    episode = tick // ticks
    ahead, end = tick[:, None] + np.arange(horizon), (episode[:, None] + 1) * ticks
    recorded = action[np.minimum(ahead, end - 1)]
    predicted = (recorded + rng.normal(0, 0.2, recorded.shape)).astype(np.float32)
    predictions = Predictions(tick, episode, predicted, recorded, ahead < end)
    store = SimpleNamespace(
        array={"tick/time": (tick % ticks) * 0.1}.__getitem__,
        action_hz=10.0,
        episodes=[
            SimpleNamespace(
                index=i, source="demo", id=f"e_{i}" * 20, ticks=range(i * ticks, (i + 1) * ticks)
            )
            for i in range(episodes)
        ],
    )
    names = tuple(f"d{index}" for index in range(dimensions))
    units = ("mm",) * (dimensions - 1) + ("",)
    groups = (
        ActionGroup("translation", "mm", tuple(range(dimensions - 1))),
        ActionGroup("gripper", "", (dimensions - 1,)),
    )
    spread = np.where(np.arange(dimensions) < dimensions - constant, 1.0, 0.0)
    rules = {way: np.full((len(tick), 1, dimensions), 0.1 * i) for i, way in enumerate(BASELINES)}
    return compare(predictions, rules, (names, units, groups, spread)), predictions, store


@pytest.mark.parametrize(
    ("episodes", "dimensions", "constant", "horizon"), [(2, 6, 1, 8), (1, 1, 0, 1)]
)
def test_every_picture_is_written(tmp_path, episodes, dimensions, constant, horizon):
    shown = evaluated(episodes, dimensions, constant=constant, horizon=horizon)
    comparison, predictions, store = shown
    instants = predictions.ticks[predictions.episodes == comparison.episodes[0]][[0, 6]]
    pictures = {
        "horizon.png": lambda: plots.draw_horizon(comparison, store.action_hz),
        "methods.png": lambda: plots.draw_methods(comparison),
        "chunks.png": lambda: plots.draw_chunks(*shown, store.episodes[0], instants),
    }
    files = write(tmp_path, pictures)
    assert len(files) == 3 and all(file.stat().st_size > 5000 for file in files)


def test_methods_are_bars_with_whiskers_and_steps_have_bands_where_groups_are_two() -> None:
    for episodes in (1, 4):
        comparison, *_ = evaluated(episodes)
        executed, chunk = plots.draw_methods(comparison).axes
        assert len(executed.patches) == len(chunk.patches) == 1 + len(BASELINES)
        assert chunk.patches[0].get_width() == pytest.approx(comparison.overall("policy"))
        assert len(chunk.lines) == (1 + len(BASELINES)) * (episodes > 1)
        (axis,) = plots.draw_horizon(comparison, 10.0).axes
        bands = [path for band in axis.collections for path in band.get_paths()]
        assert bool(bands) == (episodes > 1)
