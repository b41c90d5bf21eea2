"""What is said of a store is what stands in it, and what was planted is found, and nothing else."""

import json
import os
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import InspectParams
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.look.store.channels import summarize_streams
from pipeline.look.store.episodes import EpisodeCoverage, find_episode_issues
from pipeline.look.store.features import look_at_features, read_slot, sample_rows
from pipeline.look.store.page import StoreView, inspect_store
from pipeline.store import Episode, FeatureStore
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
        assert np.array_equal(found.newest, expected)
        rows = store.array("tick/vl_row")
        alone = store.array("tick/time") - store.array("vl/frame_time")[rows, 0]
        assert np.allclose(found.by_view["View1"], alone, equal_nan=True)
        assert np.isnan(found.by_view["View1"][rows == 3]).all()
        assert found.period_s == pytest.approx(0.3)

    def test_its_size_is_all_bytes_on_the_disk(self, path):
        view = look(path)
        files = [Path(folder, name) for folder, _, names in os.walk(path) for name in names]
        assert view.bytes == sum(file.stat().st_blocks * 512 for file in files)

    def test_coverage_is_counted_by_episode(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(slice(0, ROWS // 2), np.nan))
        first, second, *_ = look(path).episodes
        assert (first.name, first.ticks) == ("left/episode_000", slice(0, 30))
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

    def test_statistics_are_those_of_the_whole_stream(self, path):
        values = FeatureStore.open(path).array("state/values")
        found = next(one for one in look(path).statistics if one.stream == "state")
        assert found.rows == found.looked_at == len(values)
        for one, column in zip(found.channels, values.T, strict=True):
            assert one.minimum == column.min() and one.maximum == column.max()
            assert one.median == pytest.approx(np.median(column), abs=1e-6)
            assert one.mean == pytest.approx(column.mean(), abs=1e-6)
            assert one.std == pytest.approx(column.std(), rel=1e-5)

    def test_a_large_stream_is_sampled_in_bounded_memory(self, tiny_store, tmp_path):
        path = tiny_store(tmp_path, sensor_channels=64, readings_a_tick=250)
        store = FeatureStore.open(path)
        whole, limit = store.array("sensor/values").nbytes, 2**18
        assert whole > 8e6
        tracemalloc.start()
        found = summarize_streams(store, limit)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        sensor = next(one for one in found if one.stream == "sensor")
        assert sensor.rows == 45_000
        assert sensor.looked_at == limit // (4 * 64)
        assert sensor.channels[0].std == pytest.approx(1, abs=0.1)
        assert peak < 6 * limit

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


class TestSampledRows:
    def test_they_are_spread_evenly_over_the_store(self, tiny_store, tmp_path):
        sampled = look(tiny_store(tmp_path, episodes=30), points=100).features.sampled
        assert (len(sampled.rows), sampled.total) == (90, 300)
        assert sampled.rows[:6].tolist() == [0, 4, 8, 10, 14, 18]
        assert sampled.time[:4] == pytest.approx([0, 1.2, 2.4, 0])

    def test_of_more_episodes_than_rows_to_look_at_some_are_left_out(self, tiny_store, tmp_path):
        store = FeatureStore.open(tiny_store(tmp_path, episodes=30))
        assert sample_rows(store, 15).rows.tolist() == list(range(0, 300, 2 * ROWS))


class TestDuplicates:
    def test_nothing_is_found_where_all_rows_differ(self, path):
        found = look(path).duplicates
        assert (found.rows, found.pairs) == (0, ())

    def test_equal_keys_are_found_whatever_the_features(self, path, plant):
        def same(keys: np.ndarray) -> None:
            keys[5 * ROWS : 5 * ROWS + 6] = keys[2:8]

        plant(path, "vl/key", same)
        view = look(path)
        (pair,) = view.duplicates.pairs
        assert (pair.first, pair.second, pair.rows) == (0, 5, (6, 6))
        assert pair.share == pytest.approx(0.6)
        assert pair.time_s == pytest.approx(0.6)
        assert view.duplicates.rows == 12
        assert kinds(view) == [("same recording", "left", "episode_000")]

    def test_of_a_key_that_all_have_the_pairs_are_as_many_as_the_episodes(self, path, plant):
        plant(path, "vl/key", lambda keys: keys.__setitem__(slice(None), keys[0]))
        found = look(path).duplicates
        assert [(one.first, one.second) for one in found.pairs] == [(0, n) for n in range(1, 6)]
        assert found.rows == 6 * ROWS
        assert {one.rows for one in found.pairs} == {(ROWS, ROWS)}


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

    def test_a_feature_of_another_length(self, path, plant):
        plant(path, "vl/features", lambda rows: rows.__setitem__((12, 0), rows[12, 0] * 100))
        (issue,) = look(path).issues
        assert (issue.kind, issue.episode, issue.start_s) == (
            "feature norm",
            "episode_001",
            pytest.approx(0.6),
        )

    def test_of_three_rows_none_is_far_from_the_rest(self, tiny_store, tmp_path, plant):
        path = tiny_store(tmp_path, episodes=1, ticks=9)
        plant(path, "vl/features", lambda rows: rows.__setitem__((2, 0), rows[2, 0] * 100))
        assert [one.kind for one in look(path).issues] == ["short episode"]

    def test_a_missing_view(self, path, plant):
        plant(path, "vl/frame_time", lambda shown: shown.__setitem__(slice(0, ROWS), np.nan))
        (issue,) = look(path).issues
        assert (issue.kind, issue.source, issue.episode, issue.stream) == (
            "missing",
            "left",
            "episode_000",
            "view View1",
        )

    def test_old_frames_and_frames_from_the_future(self, path, plant):
        def shift(shown: np.ndarray) -> None:
            shown[:ROWS] -= 1
            shown[ROWS : 2 * ROWS] += 0.05

        plant(path, "vl/frame_time", shift)
        assert kinds(look(path)) == [
            ("old frames", "left", "episode_000"),
            ("frames from the future", "right", "episode_001"),
        ]

    def test_ticks_that_skip(self, path, plant):
        plant(path, "tick/time", lambda time: np.add(time[5:30], 10, out=time[5:30]))
        (issue,) = [one for one in look(path).issues if one.kind == "gap"]
        assert (issue.start_s, issue.stop_s) == pytest.approx((0.4, 10.5))

    def test_an_episode_with_another_instruction_or_none(self, tiny_store, tmp_path, plant):
        path = tiny_store(tmp_path, episodes=12)

        def say(text: np.ndarray, episode: int, words: bytes) -> None:
            start = FeatureStore.open(path).array("episode/text_start")[episode]
            found = text.tobytes().index(b"touch the dot", start)
            text[found : found + 13] = np.frombuffer(words.ljust(13), np.uint8)

        plant(path, "episode/text", lambda text: (say(text, 3, b"lift the cup"), say(text, 4, b"")))
        assert kinds(look(path)) == [
            ("other instruction", "right", "episode_003"),
            ("no instruction", "left", "episode_004"),
        ]

    def test_as_many_instructions_as_episodes_take_no_time(self):
        none = range(0)
        nothing = {"ticks": none, "vl_rows": none, "readings": none, "states": none}
        told = {"path": "", "format": "raw", "content": "", "digest": ""}
        episodes = [
            EpisodeCoverage(
                Episode(n, str(n), "a", instruction=f"do {n}", **told, **nothing), 0, {}
            )
            for n in range(20_000)
        ]
        store: Any = SimpleNamespace(array=lambda name: np.empty(0))
        begin = time.process_time()
        found = {one.kind for one in find_episode_issues(store, episodes)}
        assert time.process_time() - begin < 4
        assert found == {"short episode"}

    def test_a_flat_channel(self, path, plant):
        plant(path, "tick/action", lambda action: action.__setitem__((slice(None), 1), 0))
        (issue,) = look(path).issues
        assert (issue.kind, issue.stream, issue.message[:2]) == ("flat channel", "action", "dy")

    @pytest.mark.parametrize("unit", ["", "rad/s"])
    @pytest.mark.parametrize("scale", [0, 1e-3])
    def test_a_joint_that_hardly_moves_is_told_once(self, path, plant, unit, scale):
        """As of recordings, whose rule it is; one that never moves is flat."""
        attributes(path, lambda attrs: attrs["streams"]["state"].update(units=4 * [unit]))
        assert look(path).issues == ()
        plant(path, "state/values", lambda state: np.multiply(state[:, 2], scale, out=state[:, 2]))
        (issue,) = look(path).issues
        kind = "still channel" if scale else "flat channel"
        assert (issue.kind, issue.severity, issue.stream) == (kind, "warning", "state")
        assert issue.message.startswith("joint_2")

    def test_channels_that_are_neither_of_one_unit_nor_of_one_kind_are_not_compared(
        self, path, plant
    ):
        said = {"names": ["x", "y", "z", "other"], "units": 4 * [""]}
        attributes(path, lambda attrs: attrs["streams"]["state"].update(said))
        plant(path, "state/values", lambda state: np.multiply(state[:, 2], 1e-3, out=state[:, 2]))
        assert look(path).issues == ()

    def test_a_channel_with_what_is_no_number(self, path, plant):
        plant(path, "state/values", lambda state: state.__setitem__((5, 1), np.nan))
        (issue,) = look(path).issues
        assert (issue.kind, issue.severity, issue.stream) == ("not finite", "error", "state")
        assert issue.message.startswith("joint_1: ")

    def test_short_episodes(self, tiny_store, tmp_path):
        view = look(tiny_store(tmp_path, ticks=6, episodes=2))
        assert [one.kind for one in view.issues if one.kind == "short episode"] == 2 * [
            "short episode"
        ]

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
        assert issue.start_s == issue.stop_s == pytest.approx(1.2)
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
    look_at_features(store, sample_rows(store, 200))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < whole / 3
