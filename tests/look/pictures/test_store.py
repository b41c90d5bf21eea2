"""Pictures of a store show what was found, for the smallest store and for one with flaws."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import matplotlib.image as mpl_image
import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.base.config import InspectParams
from pipeline.look.page.style import INK, RC, write
from pipeline.look.store import draw as pictures
from pipeline.look.store import draw_features as feature_pictures
from pipeline.look.store import draw_interactive as store_interactive
from pipeline.look.store.facts import StoreView, inspect_store
from pipeline.store import FeatureStore

ROWS = 10
EVERY: dict[str, Callable[[StoreView], Figure]] = {
    "coverage": pictures.coverage,
    "ages": pictures.ages,
    "sizes": pictures.sizes,
    "norms": feature_pictures.norms,
    "projection_episode": lambda view: feature_pictures.projection(view, "episode"),
    "projection_progress": lambda view: feature_pictures.projection(view, "progress"),
    "likeness": feature_pictures.likeness,
}


@pytest.fixture(scope="module")
def flawed(tiny_store, reseal, tmp_path_factory) -> StoreView:
    """Episode 4 shows what episode 1 shows, episode 0 has no view, and one feature is huge."""
    path: Path = tiny_store(tmp_path_factory.mktemp("flawed"), sensor_channels=40, slots=24)
    store = FeatureStore.open(path)

    def file(name: str) -> np.ndarray:
        like = store.array(name)
        chunk = path / name / "c" / "/".join("0" * like.ndim)
        return np.memmap(chunk, like.dtype, "r+", shape=like.shape)

    features = file("vl/features")
    features[4 * ROWS : 5 * ROWS] = features[ROWS : 2 * ROWS]
    features[33, 2] *= 50
    file("vl/frame_time")[:ROWS] = np.nan
    reseal(path)
    return inspect_store(path, InspectParams())


@pytest.fixture(scope="module")
def smallest(tiny_store, tmp_path_factory) -> StoreView:
    """One episode of one tick, no sensor and no state."""
    folder = tmp_path_factory.mktemp("smallest")
    sizes = {"slots": 1, "sensor_channels": 0, "state_dim": 0}
    return inspect_store(tiny_store(folder, episodes=1, ticks=1, **sizes), InspectParams())


@pytest.mark.parametrize("name", EVERY)
def test_every_picture_is_drawn(flawed, tmp_path, name):
    (path,) = write(tmp_path, {f"{name}.png": lambda: EVERY[name](flawed)})
    assert path.stat().st_size > 5000


@pytest.mark.parametrize("name", [name for name in EVERY if name != "likeness"])
def test_the_smallest_store_can_be_drawn(smallest, tmp_path, name):
    (path,) = write(tmp_path, {f"{name}.png": lambda: EVERY[name](smallest)})
    assert mpl_image.imread(path)[..., :3].std() > 0.01  # more than a blank sheet


def test_sources_are_parted_on_a_map_that_stays_light_on_a_dark_page(flawed):
    """A page draws ink in white where it is dark, and the map's middle is nearly white."""
    _, by_episode, _ = feature_pictures.norms(flawed).axes
    assert by_episode.lines
    assert INK not in {line.get_color() for line in by_episode.lines}


def test_coverage_marks_what_is_absent(flawed):
    with mpl.rc_context(RC):
        above, below = pictures.coverage(flawed).axes
    assert sum(len(one) for one in above.containers) == 6
    shown = np.asarray(below.collections[0].get_array()).reshape(3, 6)
    assert shown.tolist() == [[2] * 6, [2] * 6, [0, 2, 2, 2, 2, 2]]
    assert [label.get_text() for label in below.get_yticklabels()] == ["sensor", "state", "View1"]


def test_ages_are_shares_of_all_ticks(flawed):
    with mpl.rc_context(RC):
        (axis,) = pictures.ages(flawed).axes
    assert sum(bar.get_height() for bar in axis.containers[0]) == pytest.approx(100)


def test_sizes_are_of_the_whole_store(flawed):
    with mpl.rc_context(RC):
        (axis,) = pictures.sizes(flawed).axes
    total = sum(bar.get_width() for bar in axis.containers[0])
    assert total * 2**20 == pytest.approx(flawed.disk_bytes)


def test_pairs_that_are_alike_are_framed(flawed):
    with mpl.rc_context(RC):
        axis = feature_pictures.likeness(flawed).axes[0]
    (frames,) = axis.collections
    assert {tuple(place) for place in np.asarray(frames.get_offsets())} == {(1, 4), (4, 1)}


@pytest.mark.parametrize(("count", "frames"), [(200, []), (60, [60 * 59])])
def test_alike_episodes_take_a_bounded_number_of_artists(smallest, count, frames):
    """200 of them are 19 900 pairs."""
    likeness = np.ones((count, count), np.float32)
    np.fill_diagonal(likeness, np.nan)
    found = replace(smallest.duplicates, episodes=np.arange(count), likeness=likeness)
    many = replace(smallest, duplicates=found, episodes=smallest.episodes * count)
    with mpl.rc_context(RC):
        axis = feature_pictures.likeness(many).axes[0]
    assert [len(np.asarray(one.get_offsets())) for one in axis.collections] == frames
    assert (len(axis.images), len(axis.lines)) == (1, 0)


def test_every_row_is_a_dot(flawed):
    with mpl.rc_context(RC):
        axis = feature_pictures.projection(flawed, "progress").axes[0]
    assert len(axis.collections[0].get_offsets()) == 6 * ROWS


def test_dots_are_coloured_by_episode_while_each_has_its_own_colour(flawed):
    figure = store_interactive.projection(flawed, "episode")
    assert [trace.name for trace in figure.data] == [one.name for one in flawed.episodes]
    assert figure.layout.showlegend
    assert len({trace.marker.color for trace in figure.data}) == 6
    second = figure.data[1]
    assert set(second.text) == {"right/episode_001"}
    assert second.customdata[3].tolist() == pytest.approx([13, 0.9, 3 / 9])
    assert np.column_stack([second.x, second.y]) == pytest.approx(
        flawed.projection.points[ROWS : 2 * ROWS]
    )


def test_dots_of_many_episodes_are_coloured_by_source_then_by_task(tiny_store, tmp_path):
    view = inspect_store(tiny_store(tmp_path, episodes=7, ticks=6), InspectParams())
    figure = store_interactive.projection(view, "episode")
    assert (store_interactive.trait(view), [trace.name for trace in figure.data]) == (
        "source",
        ["left", "right"],
    )
    assert [len(trace.x) for trace in figure.data] == [8, 6]
    alike = [replace(one, source="left") for one in view.episodes]
    told = [replace(one, instruction=f"task {one.index % 3}") for one in alike]
    assert store_interactive.trait(replace(view, episodes=tuple(told))) == "instruction"
    one_task = replace(view, episodes=tuple(alike))
    assert store_interactive.trait(one_task) is None
    (dots,) = store_interactive.projection(one_task, "episode").data
    assert len(set(dots.marker.color)) == 6


def test_dots_are_coloured_by_progress(flawed):
    figure = store_interactive.projection(flawed, "progress")
    (dots,) = figure.data
    assert dots.marker.color.tolist() == flawed.projection.progress.tolist()
    assert [colour for _, colour in dots.marker.colorscale] == list(feature_pictures.PROGRESS)
    assert not figure.layout.showlegend
    assert figure.layout.xaxis.title.text.startswith("component 1 (")


def test_numbered_channels_are_drawn_together(flawed):
    (run,) = pictures.numbered(flawed)
    assert (run[0].name, run[-1].name, len(run)) == ("sensor_0", "sensor_39", 40)
    with mpl.rc_context(RC):
        (axis,) = pictures.wide_channels(flawed).axes
    assert len(axis.lines[0].get_xdata()) == 40
