"""The page of a store tells what is in it, and finds what was planted and nothing else."""

import json
import os
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image as mpl_image
import numpy as np
import pytest

from pipeline.base.config import InspectParams
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.look.page.blocks import Issues, Outline, Report
from pipeline.look.page.style import INK, write
from pipeline.look.page.writing import write_report
from pipeline.look.store import (
    StoreView,
    draw_norms,
    inspect_store,
    measure_features,
    read_slot,
    store_report,
)
from pipeline.store import FeatureStore
from pipeline.store.chunks import write_seal

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


def attributes(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads((path / "zarr.json").read_text())
    change(document["attributes"])
    (path / "zarr.json").write_text(json.dumps(document))
    write_seal(path)


def look(path: Path, **params: Any) -> StoreView:
    return inspect_store(path, InspectParams(**params))


def kinds(view: StoreView) -> list[tuple[str, str, str]]:
    return [(one.kind, one.source, one.episode) for one in view.issues]


class TestFacts:
    def test_a_sound_store_has_no_issue(self, path):
        assert look(path).issues == ()

    def test_ages_are_those_that_gather_gives(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(3, np.nan))
        store, found = FeatureStore.open(path), look(path).ages
        expected = store.gather(np.arange(store.ticks)).feature_age.numpy()
        assert np.array_equal(found["newest frame"], expected)
        rows = store.array("tick/vl_row")
        alone = store.array("tick/time") - store.array("vl/frame_time")[rows, 0]
        assert np.allclose(found["View1"], alone, equal_nan=True)
        assert np.isnan(found["View1"][rows == 3]).all()

    def test_its_size_is_all_bytes_on_the_disk(self, path):
        view = look(path)
        files = [Path(folder, name) for folder, _, names in os.walk(path) for name in names]
        assert view.bytes == sum(file.stat().st_blocks * 512 for file in files)

    def test_coverage_is_counted_by_episode(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(slice(0, ROWS // 2), np.nan))
        first, second, *_ = look(path).episodes
        assert first.episode.id == "episode_000"
        assert first.covered == {"sensor": 1.0, "state": 1.0, "View1": 0.5}
        assert second.covered["View1"] == 1
        assert first.seconds == pytest.approx(2.9)

    @pytest.mark.parametrize("dtype", ["float32", "float16", "bfloat16"])
    def test_features_are_read_as_gather_gives_them(self, tiny_store, tmp_path, dtype):
        store = FeatureStore.open(tiny_store(tmp_path, dtype=dtype))
        rows = np.array([0, 7, 59])
        ticks = [int(np.flatnonzero(store.array("tick/vl_row") == row)[0]) for row in rows]
        expected = store.gather(ticks).features[:, 1].float().numpy()
        assert np.array_equal(read_slot(store, rows, 1), expected)

    def test_of_variants_the_plain_frames_are_looked_at(self, tiny_store, tmp_path, plant):
        path = tiny_store(tmp_path, slots=4)

        def two_variants(attrs: dict[str, Any]) -> None:
            attrs["feature_spec"]["variants"] = 2
            attrs["slots"] = [one | {"variant": n // 2} for n, one in enumerate(attrs["slots"])]

        attributes(path, two_variants)
        plant(path, "vl/features", lambda rows: rows.__setitem__((slice(None), slice(2, 4)), 1e6))
        view = look(path)
        assert view.store.variants == 2
        assert view.features.norm.shape == (6 * ROWS, 2)
        assert view.features.norm.max() < 100

    def test_what_is_no_finished_store_says_what_to_run(self, path, tmp_path):
        with pytest.raises(StoreIncomplete, match=r"stages\.extract"):
            look(tmp_path / "none.zarr")
        part = path.rename(path.with_name("tiny.zarr.part"))
        with pytest.raises(
            StoreIncomplete, match=r"unfinished build.*stages\.extract.*tiny\.zarr\.$"
        ):
            look(part)
        archive = part.rename(path.with_name("tiny.archive.zarr"))
        attributes(archive, lambda attrs: attrs.update(archive={}))
        with pytest.raises(StoreMismatch, match=r"stages\.archive --restore"):
            look(archive)


def test_of_many_rows_evenly_spread_ones_are_looked_at(tiny_store, tmp_path):
    health = look(tiny_store(tmp_path, episodes=30), points=100).features
    assert health.rows[:6].tolist() == [0, 3, 6, 9, 12, 15] and len(health.rows) == 100
    assert health.episode[:6].tolist() == [0, 0, 0, 0, 1, 1] and health.episode[-1] == 29


class TestSharedRows:
    def test_equal_keys_are_found_whatever_the_features(self, path, plant):
        assert look(path).shared_rows == 0

        def same(keys: np.ndarray) -> None:
            keys[5 * ROWS : 5 * ROWS + 6] = keys[2:8]

        plant(path, "vl/key", same)
        view = look(path)
        assert view.shared_rows == 12
        assert kinds(view) == [("same recording", "right", "episode_005")]
        said = "6 of its 10 VL rows have exactly the frames and prompt of rows of left/episode_000"
        assert view.issues[0].message == said

    def test_of_a_key_that_all_have_the_pairs_are_as_many_as_the_episodes(self, path, plant):
        plant(path, "vl/key", lambda keys: keys.__setitem__(slice(None), keys[0]))
        view = look(path)
        assert view.shared_rows == 6 * ROWS
        assert [issue.episode for issue in view.issues] == [f"episode_00{n}" for n in range(1, 6)]


class TestIntegrity:
    """What is looked at is what was written, or nothing is shown."""

    def test_a_changed_feature_row(self, path):
        damage(path, "vl/features", lambda rows: rows.__setitem__((34, 2, 1), 0.5))
        said = r"vl/features/c/0/0/0: rows 34 to 34 of vl/features .*damaged.*stages\.verify"
        with pytest.raises(StoreIncomplete, match=said):
            look(path)

    @pytest.mark.parametrize("name", ["tick/vl_row", "vl/frame_time", "episode/vl_start"])
    def test_a_changed_narrow_array(self, path, name):
        damage(path, name, lambda values: values.__setitem__(0, values[-1]))
        with pytest.raises(StoreIncomplete, match=rf"{name}.*(trailer|offsets).*stages\.verify"):
            look(path)

    def test_changed_metadata(self, path):
        file = path / "zarr.json"
        file.write_text(file.read_text().replace('"action_hz": 10.0', '"action_hz": 20.0'))
        with pytest.raises(StoreIncomplete, match=r"metadata were changed.*stages\.verify"):
            look(path)


class TestIssues:
    def test_a_dead_slot(self, path, plant):
        plant(path, "vl/features", lambda rows: rows.__setitem__((slice(None), 1), 3.0))
        view = look(path)
        assert kinds(view) == [("dead slot", "", "")]
        assert view.features.variation[1] == 0 and view.features.variation[[0, 2]].min() > 0.5

    def test_features_that_stand_still_in_one_episode(self, path, plant):
        plant(path, "vl/features", lambda rows: rows.__setitem__(slice(30, 40), rows[30]))
        assert ("still features", "right", "episode_003") in kinds(look(path))

    def test_a_missing_view(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(slice(0, ROWS), np.nan))
        (issue,) = look(path).issues
        assert (issue.kind, issue.source, issue.episode, issue.stream) == (
            "missing",
            "left",
            "episode_000",
            "view View1",
        )

    def test_old_frames(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: np.subtract(shown[:ROWS], 1, out=shown[:ROWS]))
        (issue,) = look(path).issues
        assert (issue.kind, issue.episode) == ("old frames", "episode_000")
        assert "up to 1." in issue.message and "over 0.60 s" in issue.message

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
        sound = look(path)
        plant(path, "vl/features", lambda rows: rows.__setitem__((34, 2, 1), value))
        view = look(path)
        (issue,) = view.issues
        assert (issue.kind, issue.severity, issue.source, issue.episode) == (
            "not finite",
            "error",
            "right",
            "episode_003",
        )
        assert view.features.names[2] in issue.message
        expected = sound.features.norm.copy()
        expected[34, 2] = np.nan
        assert np.array_equal(view.features.norm, expected, equal_nan=True)

    def test_a_store_without_a_finite_row_can_be_looked_at(self, path, plant):
        plant(path, "vl/features", lambda rows: rows.__setitem__(slice(None), np.nan))
        view = look(path)
        assert [(one.kind, one.severity) for one in view.issues] == 6 * [("not finite", "error")]
        assert np.isnan(view.features.norm).all()

    def test_what_is_not_finite_does_not_count_where_its_slot_is_invalid(self, path, plant):
        plant(path, "vl/features", lambda rows: rows.__setitem__((34, 2), np.nan))
        plant(path, "vl/slot_valid", lambda valid: valid.__setitem__((34, 2), 0))
        view = look(path)
        assert view.issues == ()


def test_one_slot_at_a_time_is_in_memory(tiny_store, tmp_path):
    store = FeatureStore.open(tiny_store(tmp_path, slots=24, dim=512, episodes=20))
    whole = store.array("vl/features").nbytes
    assert whole > 9e6
    tracemalloc.start()
    measure_features(store, np.arange(200))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < whole / 3


@pytest.fixture(scope="module")
def doubled(tiny_store, reseal, tmp_path_factory) -> StoreView:
    """A store in which an episode is there twice."""
    path = tiny_store(tmp_path_factory.mktemp("store"), sensor_channels=40)
    like = FeatureStore.open(path).array("vl/key")
    keys = np.memmap(path / "vl/key/c/0/0", like.dtype, "r+", shape=like.shape)
    keys[4 * ROWS : 5 * ROWS] = keys[ROWS : 2 * ROWS]
    reseal(path)
    return inspect_store(path, InspectParams())


@pytest.fixture(scope="module")
def report(doubled) -> Report:
    return store_report(doubled)


def blocks(report: Report, title: str) -> list:
    return list(next(one for one in report.sections if one.title == title).blocks)


def test_the_sum_of_the_sources_is_the_store(report, doubled):
    table = blocks(report, "Coverage")[0]
    assert [row[0] for row in table.rows] == ["left", "right"]
    own = [part.episode for part in doubled.episodes]
    seconds = sum(part.seconds for part in doubled.episodes)
    kinds = ("ticks", "vl_rows", "readings", "states")
    whole = [len(own), seconds, *(sum(len(getattr(one, kind)) for one in own) for kind in kinds)]
    sums = [sum(row[column] for row in table.rows) for column in range(3, len(table.columns))]
    assert sums == pytest.approx(whole, abs=0.1)
    assert sums[2] == doubled.store.ticks
    assert dict(report.tiles)["ticks"] == f"{doubled.store.ticks}"


@pytest.mark.parametrize(
    ("hz", "reuse", "said"),
    [
        (10.0, 3, "Ticks at 10 Hz, features of the model (a VL row) at one in 3; feature spec"),
        (None, 1, "Ticks as recorded, features of the model (a VL row) at each of them; feature"),
    ],
)
def test_the_summary_says_what_a_row_is(doubled, hz, reuse, said):
    attrs = {**doubled.store.attrs, "action_hz": hz, "vlm_reuse_count": reuse}
    store = FeatureStore(
        doubled.store.path, attrs, {"tick/time": np.empty(0), "vl/time": np.empty(0)}
    )
    summary = store_report(replace(doubled, store=store)).summary
    assert summary.startswith(said)


def test_what_looks_wrong_is_named_with_its_episode(report):
    issues, checked = blocks(report, "What looks wrong")
    assert isinstance(issues, Issues)
    assert "all 60 VL rows give the checksums" in checked.words
    assert "python -m stages.verify --set verify.store=" in checked.words
    (issue,) = issues.issues
    assert (issue.kind, issue.episode) == ("same recording", "episode_004")
    assert "right/episode_001" in issue.message
    words = blocks(report, "Reuse of the features")[-1]
    assert "20 of 60 VL rows" in words.words


def test_rows_that_are_not_finite_are_said_to_be_left_out(doubled):
    def words(broken, norm):
        features = replace(doubled.features, broken=broken, norm=norm)
        return blocks(store_report(replace(doubled, features=features)), "Features")

    norm = doubled.features.norm
    first, _ = words(np.arange(len(norm))[:, None] == 34, norm)
    assert "all VL rows, without what is not finite in 1 of them" in first.words
    (only,) = words(np.ones(norm.shape, np.bool_), np.full_like(norm, np.nan))
    assert only.words.endswith("none has finite features.")


def test_the_spec_is_there_whole(report, doubled):
    first = blocks(report, "What it was made of")[0]
    assert isinstance(first, Outline)
    assert json.dumps(first.content) == json.dumps(doubled.store.spec)


def test_the_page_loads(report, tmp_path, assert_page_is_sound):
    page, *pictures = write_report(tmp_path / "page", report)
    assert {one.stem for one in pictures} >= {"norms"}
    assert_page_is_sound(page)


def test_an_episode_says_what_its_ticks_do_not_see(doubled):
    first, *others = doubled.episodes
    covered = {**first.covered, "sensor": 0.0, "View1": 0.999}
    odd = replace(doubled, episodes=(replace(first, covered=covered), *others))
    table = blocks(store_report(odd), "Coverage")[-1]
    assert [row[-1] for row in table.rows[:2]] == ["no sensor, 99% View1", "all"]


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


def test_every_picture_is_drawn(flawed, tmp_path):
    (path,) = write(tmp_path, {"norms.png": lambda: draw_norms(flawed.features, flawed.episodes)})
    assert path.stat().st_size > 5000


def test_the_smallest_store_can_be_drawn(smallest, tmp_path):
    (path,) = write(
        tmp_path, {"norms.png": lambda: draw_norms(smallest.features, smallest.episodes)}
    )
    assert mpl_image.imread(path)[..., :3].std() > 0.01  # more than a blank sheet


def test_sources_are_parted_on_a_map_that_stays_light_on_a_dark_page(flawed):
    """A page draws ink in white where it is dark, and the map's middle is nearly white."""
    _, by_episode, _ = draw_norms(flawed.features, flawed.episodes).axes
    assert by_episode.lines
    assert INK not in {line.get_color() for line in by_episode.lines}
