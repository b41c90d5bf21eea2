"""Pictures are written for any shape of data, whole, and the same for the same numbers."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.evaluate.baselines import BASELINES
from pipeline.evaluate.probe.inputs import SlotName
from pipeline.evaluate.probe.ridge import ProbeFolds, ProbeScore
from pipeline.evaluate.probe.study import Known, ProbeResult, ProbeStudy
from pipeline.look import evaluation as plots
from pipeline.look import probe
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


def pictures(comparison: Comparison, predictions: Predictions, store: Any) -> dict[str, Any]:
    """Each picture of an evaluation by its file's name."""
    instants = predictions.ticks[predictions.episodes == comparison.episodes[0]][[0, 6]]

    def chunks() -> Figure:
        return plots.draw_chunks(comparison, predictions, store, store.episodes[0], instants)

    return {
        "horizon.png": lambda: plots.draw_horizon(comparison, store.action_hz),
        "methods.png": lambda: plots.draw_methods(comparison),
        "chunks.png": chunks,
    }


@pytest.mark.parametrize(
    ("episodes", "dimensions", "constant", "horizon"), [(2, 6, 1, 8), (1, 1, 0, 1)]
)
def test_every_picture_is_written(tmp_path, episodes, dimensions, constant, horizon):
    shown = evaluated(episodes, dimensions, constant=constant, horizon=horizon)
    files = write(tmp_path, pictures(*shown))
    assert len(files) == 3 and all(file.stat().st_size > 5000 for file in files)


def test_whole_chunks_are_drawn_at_their_instants() -> None:
    comparison, predictions, store = evaluated(2)
    figure = pictures(comparison, predictions, store)["chunks.png"]()
    for axis, dimension in zip(figure.axes, range(4), strict=True):
        whole = [line for line in axis.lines if len(line.get_xdata()) == 3]
        assert [line.get_xdata()[0] for line in whole] == pytest.approx([0.0, 0.6])
        np.testing.assert_array_equal(whole[1].get_ydata(), predictions.predicted[6, :, dimension])
    episode: Any = store.episodes[1]
    last: Any = plots.draw_chunks(comparison, predictions, store, episode, np.array([23]))
    assert len(last.axes) == 4, "a chunk ends with its episode"
    assert [1.1] in [pytest.approx(line.get_xdata()) for line in last.axes[0].lines]


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


def score(mean: float, spread: float = 0.02) -> ProbeScore:
    """Of three recordings and two targets, of which one does not vary."""
    r2 = mean + spread * np.array([-1.0, 0.0, 1.0])
    losses = np.stack([10 * (1 - r2), np.full(3, np.nan)], axis=1)
    return ProbeScore(losses[None], np.full(3, 10.0), np.ones((1, 3)))


def found(name: SlotName, mean: float, slots: int = 1) -> ProbeResult:
    """Alone half as good as beside."""
    size = 8 * slots
    return ProbeResult(name, tuple(range(slots)), size, size, 1.0, score(mean / 2), score(mean))


def probed(layers: int = 2) -> ProbeStudy:
    """Each layer has a mean, a mean a view and a grid of 2 x 2 cells a view."""
    slots, groups = [], []
    for layer in range(layers):
        for norm in (True, False):
            places = [("mean", None, None), *(("view_mean", view, None) for view in "AB")]
            cells = [(row, column) for row in range(2) for column in range(2)]
            places += [("grid", view, cell) for view in "AB" for cell in cells]
            for pooling, view, cell in places:
                place = (cell or (0, 0))[0] * 0.1 + (cell or (0, 0))[1] * 0.01
                mean = 0.3 + 0.1 * layer + place
                name = SlotName(layer, norm, pooling, view, cell)
                slots.append(found(name, mean))
            groups += [
                found(SlotName(layer, norm, pooling), 0.5, count)
                for pooling, count in (("mean", 1), ("view_mean", 2), ("grid", 8))
            ]
    folds = ProbeFolds(np.arange(30), np.arange(30) // 10, np.arange(3)[None], ())
    known = (Known("past actions", 10, score(0.1)), Known("past actions + state", 15, score(0.2)))
    return ProbeStudy(2, folds, score(-0.01), known, tuple(slots), tuple(groups))


def test_slots_are_a_map_over_layers_and_cells_a_map_a_view() -> None:
    overview, *maps, bar = probe.draw_gains(probed()).axes
    assert [len(overview.get_yticklabels()), len(overview.get_xticklabels())] == [4, 5]
    # Layer 1 is better than layer 0, of which two maps are left out.
    titles = [f"layer 1{norm}, {view}" for norm in ("", ", no norm") for view in "AB"]
    assert [axis.get_title() for axis in maps[:4]] == titles and len(maps) == 6
    np.testing.assert_allclose(maps[0].images[0].get_array(), [[0.2, 0.21], [0.3, 0.31]])
    assert all(
        axis.images[0].get_clim() == pytest.approx((0.0, 0.31)) for axis in (overview, *maps)
    )
    assert bar.lines[-1].get_ydata()[0] == 0
