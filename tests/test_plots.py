"""Pictures are written for any shape of data, whole, and the same for the same numbers."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline import plots
from pipeline.evaluation import (
    Comparison,
    Experiment,
    Group,
    ModalityStudy,
    Predictions,
    Spoilt,
    baselines,
    compare,
)

Drawn = tuple[Comparison, Predictions, SimpleNamespace]


def evaluated(episodes: int, dimensions: int = 5, ticks: int = 12, constant: int = 1) -> Drawn:
    """`constant` dimensions at the end never vary."""
    rng = np.random.default_rng(0)
    horizon = 3
    action = rng.normal(size=(episodes * ticks, dimensions)).astype(np.float32)
    action[:, dimensions - constant :] = 1
    tick = np.arange(episodes * ticks)
    episode = tick // ticks
    ahead = tick[:, None] + np.arange(horizon)
    end = (episode[:, None] + 1) * ticks
    recorded = action[np.minimum(ahead, end - 1)]
    predictions = Predictions(
        tick,
        episode,
        (recorded + rng.normal(0, 0.2, recorded.shape)).astype(np.float32),
        recorded,
        ahead < end,
    )
    arrays = {
        "tick/action": action,
        "tick/time": (tick % ticks) * 0.1,
        "episode/tick_start": np.arange(episodes + 1) * ticks,
    }
    store = SimpleNamespace(
        array=arrays.__getitem__,
        action_hz=10.0,
        streams={"action": {"kind": "delta"}},
        episodes=[
            SimpleNamespace(
                source="demo", id=f"episode_{i}" * (1 + i), ticks=range(i * ticks, (i + 1) * ticks)
            )
            for i in range(episodes)
        ],
    )
    names = [f"d{index}" for index in range(dimensions)]
    units = ["mm"] * (dimensions - 1) + [""]
    groups = (
        Group("translation", "mm", tuple(range(dimensions - 1))),
        Group("gripper", "", (dimensions - 1,)),
    )
    spread = np.where(np.arange(dimensions) < dimensions - constant, 1.0, 0.0)
    comparison = compare(
        predictions,
        baselines(store, predictions, action.mean(0)),  # type: ignore[arg-type]
        names,
        units,
        groups,
        spread,
    )
    return comparison, predictions, store


@pytest.mark.parametrize(
    ("episodes", "dimensions", "constant"), [(1, 5, 1), (2, 2, 0), (3, 14, 1), (2, 3, 3)]
)
def test_every_picture_is_written(
    tmp_path: Path, episodes: int, dimensions: int, constant: int
) -> None:
    files = plots.write_plots(tmp_path, *evaluated(episodes, dimensions, constant=constant))  # type: ignore[arg-type]
    assert {file.name for file in files} == {
        "timeline.png",
        "scatter.png",
        "horizon.png",
        "episodes.png",
    }
    for file in files:
        assert file.read_bytes().startswith(b"\x89PNG")
        assert file.stat().st_size > 5000


def test_the_same_numbers_are_the_same_bytes(tmp_path: Path) -> None:
    written = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        files = plots.write_plots(tmp_path / name, *evaluated(2))  # type: ignore[arg-type]
        written.append([file.read_bytes() for file in files])
    assert written[0] == written[1]


def texts(figure: Figure) -> str:
    said = [figure.get_suptitle()]
    for axis in figure.axes:
        said += [axis.get_title(), axis.get_xlabel(), axis.get_ylabel()]
    return "\n".join(said)


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (lambda c, p, s: plots.timeline(c, p, s), ["d0 [mm]", "time since the episode began [s]"]),
        (lambda c, p, s: plots.scatter(c, p), ["recorded [mm]", "policy [mm]"]),
        (lambda c, p, s: plots.horizon(c, 10.0), ["[100 ms each]", "mean absolute error [mm]"]),
        (
            lambda c, p, s: plots.episodes(c, s),
            ["error [mm]", "worst by overall error on top"],
        ),
    ],
)
def test_axes_carry_units_and_titles_say_what_one_sees(
    draw: Callable[..., Figure], said: list[str]
) -> None:
    figure = draw(*evaluated(2))
    assert figure.get_suptitle()
    for part in said:
        assert part in texts(figure)


def test_what_never_varies_takes_no_panel() -> None:
    comparison, _, store = evaluated(2)
    assert len(plots.horizon(comparison, None).axes) == 1
    assert len(plots.episodes(comparison, store).axes) == 1  # type: ignore[arg-type]


def test_many_episodes_are_thinned_but_not_the_extremes() -> None:
    comparison, _, store = evaluated(60, ticks=4)
    figure = plots.episodes(comparison, store)  # type: ignore[arg-type]
    assert len(figure.axes[0].get_yticks()) == plots.EPISODE_LINES
    assert "40 of 60" in figure.get_suptitle()
    policy = plots.LABELS["policy"]
    lines = figure.axes[0].lines
    shown = next(line.get_xdata() for line in lines if line.get_label() == policy)
    errors = comparison.groups[0].mean(comparison.scores["policy"].mae_episode)
    assert shown[-1] == pytest.approx(errors.max())
    assert shown[0] == pytest.approx(errors.min())


def test_a_picture_never_writes_through_a_link(tmp_path: Path) -> None:
    cache, report = tmp_path / "cache.png", tmp_path / "report"
    report.mkdir()
    cache.write_bytes(b"cached")
    (report / "timeline.png").hardlink_to(cache)
    plots.write_plots(report, *evaluated(1))  # type: ignore[arg-type]
    assert cache.read_bytes() == b"cached"


def heights(figure: Figure) -> list[list[float]]:
    """The heights of the bars of each panel, from left to right."""
    return [[patch.get_height() for patch in axis.patches] for axis in figure.axes]


def studied(*errors: float) -> ModalityStudy:
    """A study whose policy, in the first dimension of two, is wrong by these, intact first."""

    def judged(error: float) -> Comparison:
        recorded = np.zeros((4, 1, 1), np.float32)
        ticks = np.arange(4)
        predictions = Predictions(
            ticks, ticks // 2, recorded + np.float32(error), recorded, np.ones((4, 1), bool)
        )
        rules = {
            name: np.full((4, 1, 1), wrong, np.float32)
            for name, wrong in (("zero_action", 5), ("mean_action", 3), ("repeat_last", 4))
        }
        one = (Group("translation", "mm", (0,)),)
        return compare(predictions, rules, ["dx"], ["mm"], one, np.ones(1))

    ways = (("sensor", "zeroed"), ("sensor", "delayed 50 ms"), ("features", "shuffled"))
    spoilt = tuple(
        Spoilt(stream, how, judged(error))
        for (stream, how), error in zip(ways, errors[1:], strict=True)
    )
    return ModalityStudy(judged(errors[0]), spoilt, (), 4)


def test_what_each_stream_is_worth_stands_beside_intact_and_best_baseline(tmp_path: Path) -> None:
    figure = plots.modalities(studied(0.5, 1.0, 0.75, 2.0))
    assert [axis.get_title() for axis in figure.axes] == ["sensor", "features"]
    assert heights(figure) == [[2.0, 1.5], [4.0]]
    for axis in figure.axes:
        assert [line.get_ydata()[0] for line in axis.lines] == [1.0, 6.0]
    assert "mean training action" in figure.legends[0].get_texts()[1].get_text()
    assert "4 held-out ticks, 4 chunk(s) a tick" in figure.get_suptitle()
    assert "zeroed: every value at its training mean" in figure.legends[0].get_title().get_text()
    (file,) = plots.write_modalities_plot(tmp_path, studied(0.5, 1.0, 0.75, 2.0))
    assert file.read_bytes().startswith(b"\x89PNG")


def test_a_policy_without_error_is_drawn_too() -> None:
    assert heights(plots.modalities(studied(0.0, 1.0, 0.0, 2.0))) == [[1.0, 0.0], [2.0]]


def compared(errors: dict[str, float], rules: dict[str, float]) -> list[Experiment]:
    """Two experiments an expert."""
    return [
        Experiment(
            f"{expert}-{fusion}", expert, fusion, 10, 100, 1,
            {"overall": {"policy": error, **rules}}, None,
        )
        for expert, error in errors.items()
        for fusion in ("concat", "gated")
    ]  # fmt: skip


def test_experiments_are_bars_and_baselines_lines(tmp_path: Path) -> None:
    rules = {"zero_action": 3.0, "mean_action": 2.0, "repeat_last": 1.0}
    experiments = compared({"regression": 0.3, "diffusion": 0.4}, rules)
    (axis,) = plots.comparison_of_experiments(experiments).axes
    assert [patch.get_width() for patch in axis.patches] == [0.3, 0.3, 0.4, 0.4]
    assert [line.get_xdata()[0] for line in axis.lines] == list(rules.values())
    assert [label.get_text() for label in axis.get_yticklabels()] == [e.name for e in experiments]
    assert [text.get_text() for text in axis.texts] == ["0.300", "0.300", "0.400", "0.400"]
    (file,) = plots.write_experiments_plot(tmp_path, experiments)
    assert file.read_bytes().startswith(b"\x89PNG")


def test_numbers_of_experiments_lie_on_nothing() -> None:
    """Errors just short of a baseline, where a number at the bar's end would lie on its line."""
    rules = {"zero_action": 0.52, "mean_action": 0.46, "repeat_last": 0.45}
    figure = plots.comparison_of_experiments(
        compared({"regression": 0.44, "diffusion": 0.5}, rules)
    )
    figure.draw_without_rendering()
    (axis,) = figure.axes
    for text in axis.texts:
        assert text.get_window_extent().x0 > axis.get_window_extent().x1
        assert text.get_window_extent().x1 < figure.bbox.x1
