"""The page of a store says what was found, and loads without trouble."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.base.config import InspectParams
from pipeline.look.page.blocks import Document, Issues, Report
from pipeline.look.page.writing import write_report
from pipeline.look.store.page import StoreView, inspect_store, store_report
from pipeline.store import FeatureStore

ROWS = 10


@pytest.fixture(scope="module")
def view(tiny_store, reseal, tmp_path_factory) -> StoreView:
    """A store in which an episode is there twice."""
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


def test_the_sum_of_the_sources_is_the_store(report, view):
    table = blocks(report, "Coverage")[0]
    assert [row[0] for row in table.rows] == ["left", "right"]
    own = [part.episode for part in view.episodes]
    seconds = sum(part.seconds for part in view.episodes)
    kinds = ("ticks", "vl_rows", "readings", "states")
    whole = [len(own), seconds, *(sum(len(getattr(one, kind)) for one in own) for kind in kinds)]
    sums = [sum(row[column] for row in table.rows) for column in range(3, len(table.columns))]
    assert sums == pytest.approx(whole, abs=0.1)
    assert sums[2] == view.store.ticks
    assert dict(report.tiles)["ticks"] == f"{view.store.ticks}"


@pytest.mark.parametrize(
    ("hz", "reuse", "said"),
    [
        (10.0, 3, "Ticks at 10 Hz, features of the model (a VL row) at one in 3; feature spec"),
        (None, 1, "Ticks as recorded, features of the model (a VL row) at each of them; feature"),
    ],
)
def test_the_summary_says_what_a_row_is(view, hz, reuse, said):
    attrs = {**view.store.attrs, "action_hz": hz, "vlm_reuse_count": reuse}
    store = FeatureStore(view.store.path, attrs, {"tick/time": np.empty(0)})
    summary = store_report(replace(view, store=store)).summary
    assert summary.startswith(said)


def test_what_looks_wrong_is_named_with_episode_and_time(report):
    issues, checked = blocks(report, "What looks wrong")
    assert isinstance(issues, Issues)
    assert "all 60 VL rows give the checksums" in checked.words
    assert "python -m stages.verify --set verify.store=" in checked.words
    (issue,) = issues.issues
    assert (issue.kind, issue.episode) == ("same recording", "episode_001")
    assert "left/episode_004" in issue.message
    (words,) = blocks(report, "Duplicates")
    assert "20 of 60 VL rows" in words.words


def test_rows_that_are_not_finite_are_said_to_be_left_out(view):
    def words(broken, norm):
        features = replace(view.features, broken=broken, norm=norm)
        return blocks(store_report(replace(view, features=features)), "Features")

    norm = view.features.norm
    first, _ = words(np.arange(len(norm))[:, None] == 34, norm)
    assert "all VL rows, but for what is not finite in 1 of them" in first.words
    (only,) = words(np.ones(norm.shape, np.bool_), np.full_like(norm, np.nan))
    assert only.words.endswith("none has features that are numbers.")


def test_the_spec_is_there_whole(report, view):
    first = blocks(report, "What it was made of")[0]
    assert isinstance(first, Document)
    assert json.dumps(first.content) == json.dumps(view.store.spec)


def test_the_page_loads(report, tmp_path, assert_page_is_sound):
    page, *pictures = write_report(tmp_path / "page", report)
    assert {one.stem for one in pictures} >= {"norms"}
    assert_page_is_sound(page)


def test_an_episode_says_what_its_ticks_do_not_see(view):
    first, *others = view.episodes
    covered = {**first.covered, "sensor": 0.0, "View1": 0.999}
    odd = replace(view, episodes=(replace(first, covered=covered), *others))
    table = blocks(store_report(odd), "Coverage")[-1]
    assert [row[-1] for row in table.rows[:2]] == ["no sensor, 99% View1", "all"]
