"""The page of a store says what was found, and loads without trouble."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.base.config import InspectParams
from pipeline.look.page.blocks import Document, Notices, Report, Table
from pipeline.look.page.writing import write_report
from pipeline.look.store.facts import StoreView, inspect_store
from pipeline.look.store.page import store_report
from pipeline.store import FeatureStore

ROWS = 10


@pytest.fixture(scope="module")
def view(tiny_store, reseal, tmp_path_factory) -> StoreView:
    """A store in which an episode is there twice."""
    path = tiny_store(tmp_path_factory.mktemp("store"), sensor_channels=40)
    like = FeatureStore.open(path).array("vl/features")
    features = np.memmap(path / "vl/features/c/0/0/0", like.dtype, "r+", shape=like.shape)
    features[4 * ROWS : 5 * ROWS] = features[ROWS : 2 * ROWS]
    reseal(path)
    return inspect_store(path, InspectParams())


@pytest.fixture(scope="module")
def report(view) -> Report:
    return store_report(view)


def blocks(report: Report, title: str) -> list:
    return list(next(one for one in report.sections if one.title == title).blocks)


def test_the_sum_of_the_sources_is_the_store(report, view):
    table = blocks(report, "Coverage")[0]
    *sources, total = table.rows
    assert [row[0] for row in sources] == ["left", "right"]
    for column in range(3, len(total)):
        assert total[column] == pytest.approx(sum(row[column] for row in sources))
    assert dict(report.tiles)["ticks"] == f"{view.ticks}"


@pytest.mark.parametrize(
    ("hz", "reuse", "said"),
    [
        (10.0, 3, "Ticks at 10 Hz, features of the model (a VL row) at one in 3; feature spec"),
        (None, 1, "Ticks as recorded, features of the model (a VL row) at each of them; feature"),
    ],
)
def test_the_summary_says_what_a_row_is(view, hz, reuse, said):
    summary = store_report(replace(view, action_hz=hz, vlm_reuse_count=reuse)).summary
    assert summary.startswith(said)


def test_what_looks_wrong_is_named_with_episode_and_time(report):
    notices, checked = blocks(report, "What looks wrong")
    assert isinstance(notices, Notices)
    assert "all 60 VL rows give the checksums" in checked.words
    assert "python -m stages.verify --set verify.store=" in checked.words
    (notice,) = notices.notices
    assert notice.kind == "near-duplicate episodes"
    assert "episode_001" in notice.where and "left/episode_004" in notice.message
    tables = [one for one in blocks(report, "Near-duplicates") if isinstance(one, Table)]
    assert tables[0].rows[0][0] == "right/episode_001"


def test_sizes_list_every_array(report, view):
    table = next(one for one in blocks(report, "Size") if isinstance(one, Table))
    assert [row[0] for row in table.rows] == [one.name for one in view.sizes]
    assert table.columns[-2:] == ("on the disk [MiB]", "share [%]")
    assert sum(row[-2] for row in table.rows) * 2**20 == pytest.approx(view.disk_bytes)
    assert sum(row[-1] for row in table.rows) == pytest.approx(100)


def test_rows_that_are_not_finite_are_said_to_be_left_out(view):
    kept = view.sampled.but(np.arange(6 * ROWS) == 34)
    words = [one.words for one in blocks(store_report(replace(view, sampled=kept)), "Features")[:1]]
    assert words == ["Looked at: all VL rows, but 1 with what is not finite."]
    none = view.sampled.but(np.ones(6 * ROWS, np.bool_))
    (only,) = blocks(store_report(replace(view, sampled=none)), "Features")
    assert only.words == "Every VL row looked at holds features that are no numbers."


def test_the_spec_is_there_whole(report, view):
    first = blocks(report, "What it was made of")[0]
    assert isinstance(first, Document)
    assert json.dumps(first.content) == json.dumps(view.spec)


def test_the_page_loads(report, tmp_path, assert_page_is_sound):
    page, *pictures = write_report(tmp_path / "page", report)
    assert {one.stem for one in pictures} >= {"coverage", "ages", "norms", "likeness"}
    assert_page_is_sound(page)


def test_an_episode_says_what_its_ticks_do_not_see(view):
    first, *others = view.episodes
    covered = {**first.covered, "sensor": 0.0, "View1": 0.999}
    odd = replace(view, episodes=(replace(first, covered=covered), *others))
    table = blocks(store_report(odd), "Coverage")[-1]
    assert [row[-1] for row in table.rows[:2]] == ["no sensor, 99% View1", "all"]
