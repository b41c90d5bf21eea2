"""The page of a store tells what is in it, and finds what was planted and nothing else."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import InspectParams
from pipeline.base.errors import StoreIncomplete
from pipeline.look.page.blocks import Issues, Outline, Report
from pipeline.look.page.writing import write_report
from pipeline.look.store import StoreView, inspect_store, store_report
from pipeline.store import FeatureStore

ROWS = 10
"""VL rows of each of the six episodes of a tiny store."""


@pytest.fixture
def path(tiny_store, tmp_path) -> Path:
    return tiny_store(tmp_path)


@pytest.fixture
def plant(reseal) -> Callable[..., None]:
    """Change an array of a finished store in its only chunk file, as if it had been written so."""

    def change(path: Path, name: str, how: Callable[[np.ndarray], Any]) -> None:
        damage(path, name, how)
        reseal(path)

    return change


def damage(path: Path, name: str, change: Callable[[np.ndarray], Any]) -> None:
    """Change an array of a finished store in its only chunk file, behind its checksums' back."""
    like = FeatureStore.open(path).array(name)
    file = path / name / "c" / "/".join("0" * like.ndim)
    change(np.memmap(file, like.dtype, "r+", shape=like.shape))


def look(path: Path, **params: Any) -> StoreView:
    return inspect_store(path, InspectParams(**params))


def kinds(view: StoreView) -> list[tuple[str, str, str]]:
    return [(one.kind, one.source, one.episode) for one in view.issues]


class TestFacts:
    def test_ages_are_those_that_gather_gives(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(3, np.nan))
        store, found = FeatureStore.open(path), look(path).ages
        expected = store.gather(np.arange(store.ticks)).feature_age.numpy()
        assert np.array_equal(found["newest frame"], expected)
        rows = store.array("tick/vl_row")
        alone = store.array("tick/time") - store.array("vl/frame_time")[rows, 0]
        assert np.allclose(found["View1"], alone, equal_nan=True)
        assert np.isnan(found["View1"][rows == 3]).all()

    def test_coverage_is_counted_by_episode(self, path, plant):
        assert look(path).issues == ()
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(slice(0, ROWS // 2), np.nan))
        first, second, *_ = look(path).episodes
        assert first.episode.id == "episode_000" and first.seconds == pytest.approx(2.9)
        assert first.covered == {"sensor": 1.0, "state": 1.0, "View1": 0.5}
        assert second.covered["View1"] == 1


class TestIntegrity:
    """What is looked at is what was written, or nothing is shown."""

    @pytest.mark.parametrize("name", ["tick/vl_row", "vl/frame_time", "episode/vl_start"])
    def test_a_changed_narrow_array(self, path, name):
        damage(path, name, lambda values: values.__setitem__(0, values[-1]))
        with pytest.raises(StoreIncomplete, match=rf"{name}.*(trailer|offsets).*stages\.verify"):
            look(path)


class TestIssues:
    def test_a_dead_slot(self, path, plant):
        plant(path, "vl/features", lambda rows: rows.__setitem__((slice(None), 1), 3.0))
        view = look(path)
        assert kinds(view) == [("dead slot", "", "")]
        assert view.features.variation[1] == 0 and view.features.variation[[0, 2]].min() > 0.5

    def test_a_missing_view(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(slice(0, ROWS), np.nan))
        view = look(path)
        assert kinds(view) == [("missing", "left", "episode_000")]
        assert view.issues[0].stream == "view View1"
        page = store_report(view)
        assert [row[-1] for row in blocks(page, "Coverage")[-1].rows[:2]] == ["no View1", "all"]
        assert page.verdict == "1 finding to look at before training"
        assert "verify" in blocks(page, "What to do next")[0].words

    def test_an_episode_without_an_instruction(self, tiny_store, tmp_path, plant):
        path = tiny_store(tmp_path, episodes=12)

        def erase(text: np.ndarray) -> None:
            start = FeatureStore.open(path).array("episode/text_start")[4]
            at = text.tobytes().index(b"touch the dot", start)
            text[at : at + 13] = ord(" ")

        plant(path, "episode/text", erase)
        assert kinds(look(path)) == [("no instruction", "left", "episode_004")]

    @pytest.mark.parametrize(("dtype", "value"), [("float32", np.inf), ("bfloat16", 0x7FC0)])
    def test_a_row_that_is_not_finite_is_an_error_and_left_out(
        self, tiny_store, tmp_path, plant, dtype, value
    ):
        path = tiny_store(tmp_path, dtype=dtype)
        plant(path, "vl/features", lambda rows: rows.__setitem__((34, 2, 1), value))
        view = look(path)
        (issue,) = view.issues
        assert (issue.kind, issue.severity, issue.episode) == ("not finite", "error", "episode_003")
        assert view.features.names[2] in issue.message
        assert np.argwhere(view.features.broken).tolist() == [[34, 2]]
        plant(path, "vl/features", lambda rows: rows.__setitem__(slice(None), value))
        view = look(path)
        assert [(one.kind, one.severity) for one in view.issues] == 6 * [("not finite", "error")]

    def test_what_is_not_finite_does_not_count_where_its_slot_is_invalid(self, path, plant):
        plant(path, "vl/features", lambda rows: rows.__setitem__((34, 2), np.nan))
        plant(path, "vl/slot_valid", lambda valid: valid.__setitem__((34, 2), 0))
        view = look(path)
        assert view.issues == ()


@pytest.fixture(scope="module")
def view(tiny_store, reseal, tmp_path_factory) -> StoreView:
    """A store in which the rows of an episode are those of another."""
    path = tiny_store(tmp_path_factory.mktemp("store"), sensor_channels=40)
    like = FeatureStore.open(path).array("vl/key")
    keys = np.memmap(path / "vl/key/c/0/0", like.dtype, "r+", shape=like.shape)
    keys[4 * ROWS : 5 * ROWS] = keys[ROWS : 2 * ROWS]
    reseal(path)
    return inspect_store(path, InspectParams())


@pytest.fixture(scope="module")
def report(view) -> Report:
    return store_report(view)


def blocks(report: Report, title: str) -> list:
    return list(next(one for one in report.sections if one.title == title).blocks)


def test_the_page_says_what_was_read_and_what_the_store_was_made_of(report, view):
    issues, checked = blocks(report, "What looks wrong")
    assert isinstance(issues, Issues) and issues.issues == ()
    assert "60 of 60 VL rows" in checked.words and "stages.verify" in checked.words
    assert "50 of 60 VL rows" in blocks(report, "Reuse of the features")[-1].words
    spec = blocks(report, "What it was made of")[0]
    assert isinstance(spec, Outline)
    assert json.dumps(spec.content) == json.dumps(view.store.spec)


@pytest.mark.slow
def test_the_page_loads(report, tmp_path, assert_page_is_sound):
    page, *beside = write_report(tmp_path / "page", report)
    assert {one.name for one in beside} == {"findings.csv"}
    assert_page_is_sound(page)


def test_the_smallest_store_has_a_page(tiny_store, tmp_path):
    """One episode of one tick, no sensor and no state."""
    sizes = {"slots": 1, "sensor_channels": 0, "state_dim": 0}
    view = look(tiny_store(tmp_path, episodes=1, ticks=1, **sizes))
    assert write_report(tmp_path / "page", store_report(view))[0].is_file()
