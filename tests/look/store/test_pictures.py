"""Pictures of a store show what was found, for the smallest store and for one with flaws."""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import matplotlib.image as mpl_image
import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.base.config import InspectParams
from pipeline.look.page.style import INK, RC, write
from pipeline.look.store.channels import draw_profiles, find_profiles
from pipeline.look.store.features import draw_norms
from pipeline.look.store.page import StoreView, inspect_store
from pipeline.store import FeatureStore

ROWS = 10
EVERY: dict[str, Callable[[StoreView], Figure]] = {
    "norms": lambda view: draw_norms(view.features, view.episodes),
}


@pytest.fixture(scope="module")
def flawed(tiny_store, reseal, tmp_path_factory) -> StoreView:
    """Episode 0 has no view, and one feature is huge."""
    path: Path = tiny_store(tmp_path_factory.mktemp("flawed"), sensor_channels=40, slots=24)
    store = FeatureStore.open(path)

    def file(name: str) -> np.ndarray:
        like = store.array(name)
        chunk = path / name / "c" / "/".join("0" * like.ndim)
        return np.memmap(chunk, like.dtype, "r+", shape=like.shape)

    file("vl/features")[33, 2] *= 50
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


@pytest.mark.parametrize("name", EVERY)
def test_the_smallest_store_can_be_drawn(smallest, tmp_path, name):
    (path,) = write(tmp_path, {f"{name}.png": lambda: EVERY[name](smallest)})
    assert mpl_image.imread(path)[..., :3].std() > 0.01  # more than a blank sheet


def test_sources_are_parted_on_a_map_that_stays_light_on_a_dark_page(flawed):
    """A page draws ink in white where it is dark, and the map's middle is nearly white."""
    _, by_episode, _ = EVERY["norms"](flawed).axes
    assert by_episode.lines
    assert INK not in {line.get_color() for line in by_episode.lines}


def test_numbered_channels_are_drawn_together(flawed):
    profiles = list(find_profiles(flawed.statistics))
    assert [(one[0].name, one[-1].name, len(one)) for one in profiles] == [
        ("sensor_0", "sensor_39", 40)
    ]
    with mpl.rc_context(RC):
        (axis,) = draw_profiles(profiles).axes
    assert len(axis.lines[0].get_xdata()) == 40
