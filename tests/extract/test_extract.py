"""One extraction: what it writes, what it takes over, what it refuses."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import (
    ConfigError,
    DiskFull,
    NumericsError,
    RecordingError,
    StoreIncomplete,
    StoreMismatch,
)
from pipeline.data import Channels, RecordedAction, Stream, open_recordings
from pipeline.data.timeline import build_timeline
from pipeline.data.windowed import WindowedRecording
from pipeline.extract.survey import survey
from pipeline.store import FeatureStore, StoreBuild, part_path
from pipeline.store.schema import ARRAY_NAMES, INCREMENTAL
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM
from tests.extract.conftest import run
from tests.store.samples import content, flip


@pytest.fixture
def narrower(monkeypatch):
    """`narrower(folder)`: the sensor of recordings in this folder has seven channels."""

    def begin(folder: Path) -> None:
        real = WindowedRecording.sensor

        def sensor(self):
            stream = real(self)
            if folder not in Path(self.path).parents or stream is None:
                return stream
            channels = Channels(stream.channels.names[:7], stream.channels.units[:7])
            return Stream(channels, stream.time, stream.values[:, :7])

        monkeypatch.setattr(WindowedRecording, "sensor", sensor)

    return begin


class TestWhatItWrites:
    @pytest.mark.usefixtures("extracted")
    def test_streams_and_ticks_are_the_recordings(self, params):
        store = FeatureStore.open(params.extract.store)
        opened = open_recordings(params.data.sources, params.data.root)
        assert [one.id for one in store.episodes] == [one.id for one in opened.recordings]
        for episode, recording in zip(store.episodes, opened.recordings, strict=True):
            sensor, state = recording.sensor(), recording.state()
            line = build_timeline(recording, 10.0, 3, "rotvec", state, sensor)
            ticks = slice(episode.ticks.start, episode.ticks.stop)
            assert np.array_equal(store.array("tick/time")[ticks], line.time)
            assert np.array_equal(store.array("tick/action")[ticks], line.action)
            vl_row = store.array("tick/vl_row")[ticks] - episode.vl_rows.start
            assert np.array_equal(vl_row, line.vl_row)
            assert episode.instruction == recording.instruction
            for stream, rows, end, mine in (
                ("sensor", episode.readings, line.sensor_end, sensor),
                ("state", episode.states, line.state_end, state),
            ):
                inside = slice(rows.start, rows.stop)
                stored = store.array(f"tick/{stream}_end")[ticks] - rows.start
                assert np.array_equal(stored, end)
                if mine is None:
                    assert not len(rows)
                else:
                    assert np.array_equal(store.array(f"{stream}/values")[inside], mine.values)
                    assert np.array_equal(store.array(f"{stream}/time")[inside], mine.time)

    @pytest.mark.usefixtures("extracted")
    def test_features_are_what_the_model_says_of_each_row_alone(self, params):
        store = FeatureStore.open(params.extract.store)
        spec = feature_spec(
            params.vlm, "float32", store.streams["views"], lambda path: path.read_bytes().hex()
        )
        vlm, preparer = FrozenVLM.load(params.vlm, spec, "cpu"), Preparer(params.vlm, spec)
        opened = open_recordings(params.data.sources, params.data.root)
        for episode, recording in zip(store.episodes, opened.recordings, strict=True):
            cameras = recording.cameras()
            for row in (episode.vl_rows[0], episode.vl_rows[-1]):
                now = store.array("vl/time")[row]
                frames = {}
                for view, camera in cameras.items():
                    index = int(np.flatnonzero(camera.time <= now)[-1])
                    (frames[view],) = camera.read([index])
                alone, valid = vlm.encode([preparer.prepare(recording.instruction, frames)])
                stored = store.array("vl/features")[row]
                assert torch.allclose(torch.from_numpy(stored), alone[0], atol=2e-5)
                assert np.array_equal(store.array("vl/slot_valid")[row], valid[0].numpy())

    def test_stored_dtypes(self, changed):
        params = changed(extract={"dtype": "bfloat16", "sensor_dtype": "float16"})
        run(params)
        batch = FeatureStore.open(params.extract.store).gather([0])
        assert batch.features.dtype == torch.bfloat16
        assert batch.sensor.dtype == torch.float16

    def test_a_sensor_that_does_not_fit_float16_is_refused(self, changed, recordings):
        path = recordings / "Touch_dot/episode_1/sensor_data.npz"
        stored = dict(np.load(path))
        stored["data"][3, 5, 7] = 1e6
        np.savez(path, **stored)
        with pytest.raises(NumericsError, match=r"aline_0006 = 1e\+06.*float16.*sensor_dtype"):
            run(changed(extract={"sensor_dtype": "float16"}))


class TestWhatItTakesOver:
    @pytest.mark.usefixtures("extracted")
    def test_nothing_changed_imports_nothing_that_takes_seconds(self, params_file):
        heavy = {"torch", "transformers", "dask", "distributed", "peft", "scipy", "matplotlib"}
        code = (
            "import sys\nfrom stages.extract import main\nfrom stages.command import run\n"
            "assert run('', main, sys.argv[1:]) == 0\n"
            f"print(sorted({heavy} & sys.modules.keys()))"
        )
        command = [sys.executable, "-c", code, "--params", str(params_file)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert "nothing to do" in done.stdout
        assert done.stdout.splitlines()[-1] == "[]"

    @pytest.mark.usefixtures("extracted")
    def test_an_added_episode_computes_only_its_rows(
        self, params, recordings, counted, write_episode
    ):
        before = FeatureStore.open(params.extract.store)
        known = {bytes(key): row for row, key in enumerate(before.array("vl/key"))}
        counted.clear()
        write_episode(recordings / "Touch_dot" / "episode_0", 9)
        report, said = run(params)
        store = FeatureStore.open(params.extract.store)
        (added,) = (one for one in store.episodes if one.id == "episode_0")
        assert sum(counted) == len(added.vl_rows) == report.computed
        assert report.taken == len(known)
        assert any("1 episode(s) are new" in line for line in said)
        for row, key in enumerate(store.array("vl/key")):
            if bytes(key) in known:
                old = before.array("vl/features")[known[bytes(key)]]
                assert np.array_equal(store.array("vl/features")[row], old)

    @pytest.mark.usefixtures("extracted")
    def test_another_reuse_count_takes_the_rows_whose_key_is_known(self, params, changed, counted):
        rows = len(FeatureStore.open(params.extract.store).array("vl/time"))
        counted.clear()
        report, said = run(changed(data={"vlm_reuse_count": 1}))
        assert report.taken == rows
        assert sum(counted) == report.rows - rows
        assert any(f"{rows} known" in line for line in said), "without decoding a frame"
        assert any("are new or have other files" in line for line in said)
        assert not any("are gone" in line for line in said)

    @pytest.mark.usefixtures("extracted")
    def test_another_prompt_computes_everything_and_says_why(self, params, changed, counted):
        counted.clear()
        report, said = run(changed(vlm={"prompt": "{images} do: {instruction}"}))
        assert report.taken == 0
        assert sum(counted) == report.rows
        assert any('prompt: "{instruction}' in line for line in said)

    @pytest.mark.usefixtures("extracted", "no_model")
    def test_what_changes_nothing(self, params, changed, recordings, monkeypatch):
        monkeypatch.delattr(Image, "open")  # no frame is looked at
        knobs = {"batch_size": 1, "decode_threads": 1, "device": "cpu"}
        assert run(changed(extract=knobs, vlm={"attention": "eager"}))[0] is None
        path = recordings / "Touch_dot/episode_1/robot_states.npz"
        path.write_bytes(path.read_bytes())
        nothing = "up to date, nothing to do (stages.verify reads what it holds)"
        assert run(params) == (None, [f"{params.extract.store}: {nothing}"]), "a touched file"
        ledger = params.extract.store.with_name("made.zarr.files.sqlite")
        ledger.write_bytes(ledger.read_bytes()[:100] + b"no database" * 100)
        assert run(params)[0] is None, "a lost ledger costs only reading"

    @pytest.mark.usefixtures("extracted")
    def test_a_group_is_kept_and_stores_without_one_are_as_before(self, params, recordings):
        text = FeatureStore.open(params.extract.store).array("episode/text").tobytes()
        assert b"group" not in text
        path = next(recordings.rglob("metadata.json"))
        path.write_text(json.dumps(json.loads(path.read_text()) | {"group": "monday"}))
        run(params)
        store = FeatureStore.open(params.extract.store)
        told = {Path(episode.path).name: episode.group for episode in store.episodes}
        assert told.pop(path.parent.name) == "monday"
        assert told
        assert not any(told.values())

    def test_a_link_to_other_files_of_equal_size_and_time_is_noticed(
        self, params, recordings, tmp_path
    ):
        episode, contents = recordings / "Touch_dot" / "episode_1", []
        places = [tmp_path / "first", tmp_path / "second"]
        shutil.copytree(episode, places[1])
        episode.rename(places[0])
        for place in places:
            path = place / "robot_states.npz"
            if contents:
                data = bytearray(path.read_bytes())
                data[200] ^= 1
                path.write_bytes(data)
                os.utime(path, ns=(0, (places[0] / path.name).stat().st_mtime_ns))
            episode.unlink(missing_ok=True)
            episode.symlink_to(place)  # equal names, sizes and times, other bytes
            with closing(ContentDigests(ledger_path(params.extract.store))) as digests:
                contents.append(survey(params, digests).contents)
        assert len(contents[0] - contents[1]) == 1

    @pytest.mark.usefixtures("extracted")
    def test_a_changed_file_is_noticed(self, params, recordings):
        run(params)  # notes what the files hold
        path = recordings / "Touch_dot/episode_1/robot_states.npz"
        stored = dict(np.load(path))
        for name in stored:
            stored[name] = stored[name] + 1
        np.savez(path, **stored)
        report, said = run(params)
        assert report.computed == 0, "its frames did not change"
        assert any("1 episode(s) are new or have other files" in line for line in said)
        assert any("1 episode(s) of the store are gone" in line for line in said)


class TestAbandonedBuilds:
    def test_their_rows_are_taken_over_however_many_there_are(
        self, params, changed, interrupted, counted
    ):
        interrupted(params, 8)
        for index, reuse in enumerate((2, 1, 2)):
            interrupted(changed(data={"vlm_reuse_count": reuse}), 12 + index)
        counted.clear()
        report, _ = run(params)
        assert report.taken >= 8
        assert sum(counted) == report.rows - report.taken
        assert not list(params.extract.store.parent.glob("*.known-*"))

    def test_a_refused_run_leaves_them_alone(self, params, changed, recordings, interrupted):
        interrupted(params, 8)
        (recordings / "Press/episode_3/images/View2/x.jpg").write_bytes(b"no time in its name")
        with pytest.raises(RecordingError):
            run(changed(vlm={"prompt": "{images}"}))
        (recordings / "Press/episode_3/images/View2/x.jpg").unlink()
        _, said = run(params)
        assert any("continuing the interrupted build" in line for line in said)

    def test_of_another_spec_are_given_up_and_the_difference_said(
        self, params, changed, interrupted
    ):
        interrupted(params, 8)
        _, said = run(changed(vlm={"prompt": "{images}"}))
        assert any("is given up: prompt:" in line for line in said)

    @pytest.mark.parametrize("rotten", ["tick/action", "zarr.json"])
    def test_bit_rot_is_not_sealed_as_right(
        self, params, changed, interrupted, counted, extracted_once, rotten
    ):
        interrupted(params, 8)
        part = part_path(params.extract.store)
        file = part / rotten
        if file.is_dir():
            (file,) = (path for path in (file / "c").rglob("*") if path.is_file())
            rows = bytearray(file.read_bytes())
            rows[rows.index(next(byte for byte in rows if byte))] ^= 1
            file.write_bytes(rows)
        else:
            file.write_text(file.read_text().replace('"action_hz": 10.0', '"action_hz": 20.0'))
        _, said = run(changed(extract={"plan": True}))
        assert any(str(file) in line and "laid out again" in line for line in said)
        counted.clear()
        report, _ = run(params)
        assert sum(counted) == report.rows - 8, "the rows that were done are kept"
        found, wanted = FeatureStore.open(params.extract.store), FeatureStore.open(extracted_once)
        assert found.action_hz == wanted.action_hz
        for name in ARRAY_NAMES:
            if name not in INCREMENTAL:
                assert found.array(name).tobytes() == wanted.array(name).tobytes(), name

    def test_rot_while_the_model_works_is_not_sealed_either(self, params, monkeypatch):
        real = StoreBuild.finish

        def finish(self):
            file = self.part / "tick/action/c/0/0"
            flip(file, 8)
            real(self)

        with monkeypatch.context() as patch:
            patch.setattr(StoreBuild, "finish", finish)
            with pytest.raises(StoreIncomplete, match=r"tick/action/c/0/0: .*crc32c.*same command"):
                run(params)
        assert not params.extract.store.exists()
        report, _ = run(params)
        assert report.computed == 0


class TestWhatWouldBeLost:
    """Rows that these params could not give again are kept, or the run is refused."""

    @pytest.mark.usefixtures("extracted", "no_model")
    def test_another_robot_at_the_same_store_is_refused_naming_both(
        self, params, changed, tmp_path, write_episode
    ):
        write_episode(tmp_path / "other" / "Task" / "episode_9", 9)
        before = content(params.extract.store)
        for plan in (True, False):
            other = {"sources": [{"name": "second", "path": str(tmp_path / "other")}]}
            with pytest.raises(StoreMismatch, match=r"made there, second here.*\n.*extract\.store"):
                run(changed(data=other, extract={"plan": plan}))
        assert content(params.extract.store) == before

    @pytest.mark.usefixtures("extracted", "no_model")
    def test_another_embodiment_of_the_same_source_is_refused(
        self, changed, tmp_path, narrower, write_episode
    ):
        write_episode(tmp_path / "other" / "Task" / "episode_9", 9)
        narrower(tmp_path / "other")
        other = {"sources": [{"name": "made", "path": str(tmp_path / "other")}]}
        with pytest.raises(StoreMismatch, match=r"sensor.names: .* -> "):
            run(changed(data=other))

    @pytest.mark.usefixtures("extracted")
    def test_a_source_that_is_missing_for_a_moment_costs_no_row(
        self, params, changed, recordings, counted
    ):
        store, previous = params.extract.store, params.extract.store.with_name("made.zarr.previous")
        whole, away = content(store), recordings.with_name("unmounted")
        (recordings / "Press").rename(away)
        for plan in (True, False):
            _, said = run(changed(extract={"plan": plan}))
            assert any("holds 1 episode(s) that are not in this run" in line for line in said)
            assert any(str(previous) in line for line in said)
            assert previous.exists() != plan
        assert len(FeatureStore.open(store).episodes) == 2
        _, said = run(changed(data={"vlm_reuse_count": 2}, extract={"plan": True}))
        (line,) = (line for line in said if line.startswith(f"{previous} is removed or replaced"))
        assert "holds 1 episode(s) that are not in this run" in line
        away.rename(recordings / "Press")
        _, said = run(changed(extract={"plan": True}))
        (line,) = (line for line in said if line.startswith(f"{previous} is removed or replaced"))
        assert "holds 0 episode(s) that are not in this run" in line
        report, _ = run(params)
        assert not counted, "its rows were there"
        assert report.taken == report.rows
        assert not previous.exists(), "until the next successful run"
        assert content(store) == whole

    @pytest.mark.usefixtures("extracted")
    def test_an_instruction_changed_and_changed_back_computes_nothing(
        self, params, changed, recordings, counted, write_episode
    ):
        store, previous = params.extract.store, params.extract.store.with_name("made.zarr.previous")
        whole, source = content(store), params.data.sources[0].model_dump()
        other = {"sources": [source | {"instruction": "hold still"}]}
        _, said = run(changed(data=other, extract={"plan": True}))
        (line,) = (line for line in said if str(previous) in line)
        assert "is kept as" in line
        assert sum(counted) == 0
        report, said = run(changed(data=other))
        assert sum(counted) == report.computed > 0
        (line,) = (line for line in said if line.startswith(f"{previous}: "))
        assert "MiB" in line
        assert "store gc" in line
        second = content(store)
        assert run(changed(data=other))[0] is None
        assert content(previous).items() >= whole.items(), "a run that changes nothing keeps it"
        for data, then in (({}, whole), (other, second)):
            counted.clear()
            report, _ = run(changed(data=data))
            assert not counted
            assert report.taken == report.rows
            assert content(store) == then
        write_episode(recordings / "Press" / "episode_9", 9)
        run(changed(data=other))
        assert not previous.exists(), "the store of before had no row that this one lacks"

    @pytest.mark.usefixtures("extracted")
    def test_an_interrupted_return_still_takes_the_rows_of_the_kept_store(
        self, params, recordings, monkeypatch, counted
    ):
        def stop(*_: object) -> None:
            raise KeyboardInterrupt

        away = (recordings / "Press").rename(recordings.with_name("unmounted"))
        run(params)
        away.rename(recordings / "Press")
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(StoreBuild, "mark", stop)
            run(params)
        _, said = run(params)
        assert any("continuing the interrupted build" in line for line in said)
        assert not counted, "its rows were there"

    @pytest.mark.usefixtures("extracted")
    def test_a_copy_that_the_user_made_is_not_the_one_that_was_kept(self, params, recordings):
        copies = [
            shutil.copytree(params.extract.store, f"{params.extract.store}{suffix}")
            for suffix in (".previous", ".old", ".known-good")
        ]
        before = [content(Path(copy)) for copy in copies]
        run(params)
        shutil.copytree(recordings / "Press/episode_3", recordings / "Press/episode_4")
        run(params)
        assert [content(Path(copy)) for copy in copies] == before
        shutil.rmtree(recordings / "Press")
        with pytest.raises(ConfigError, match=r"made\.zarr\.previous: .*left as it is|was left"):
            run(params)
        assert [content(Path(copy)) for copy in copies] == before


def test_recordings_without_a_camera(changed):
    params = changed(data={"views": []}, vlm={"pooling": ["mean", "text_mean"]})
    report, _ = run(params)
    store = FeatureStore.open(params.extract.store)
    assert store.array("vl/frame_time").shape == (report.rows, 0)
    assert np.isfinite(store.gather([0, 5]).feature_age.numpy()).all()
    assert run(params)[0] is None


def test_a_store_that_a_cache_handed_out_as_symbolic_links_is_not_written_through(
    params, recordings, tmp_path, monkeypatch, write_episode
):
    monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
    (recordings / "Zlast").mkdir()
    for index in range(7):
        episode = recordings / "Zlast" / f"episode_{index}"
        write_episode(episode, 20 + index, seconds=4.5, views=("View2",))
    run(params)
    cache = tmp_path / "cache"
    params.extract.store.rename(cache)
    shutil.copytree(cache, params.extract.store, copy_function=os.symlink)
    before = {path: path.read_bytes() for path in cache.rglob("*") if path.is_file()}
    write_episode(recordings / "Zlast" / "episode_8", 40)
    run(params)
    linked = params.extract.store / "sensor/values/c/0/0"
    assert linked.stat().st_ino == (cache / "sensor/values/c/0/0").stat().st_ino
    assert {path: path.read_bytes() for path in before} == before


class TestPlan:
    def test_only_says_what_it_would_do(self, changed, no_model):
        params = changed(extract={"plan": True})
        report, said = run(params)
        text = "\n".join(said)
        assert report is None
        assert "there is no store yet" in text
        assert "actions: rotations as rotvec" in text
        assert "rows: 24, 0 known, 24 to compute" in text
        assert "free" in text
        assert not params.extract.store.exists()
        assert os.listdir(params.extract.store.parent) == ["made.zarr.files.sqlite"]

    def test_says_when_ticks_are_not_the_recorded_rows(self, changed, monkeypatch):
        def joints(recording):
            time = np.arange(21) / 10 + recording.state().time[0]
            channels = Channels(("a", "b"), ("", ""))
            return RecordedAction(channels, time, np.zeros((21, 2), np.float32), "absolute", 10.0)

        monkeypatch.setattr(WindowedRecording, "action", joints)
        notes = {}
        for action_hz in (10, 1000):
            _, said = run(changed(extract={"plan": True}, data={"action_hz": action_hz}))
            notes[action_hz] = [line for line in said if "ticks at" in line]
        assert notes[10] == []
        (note,) = notes[1000]
        assert note.startswith("source 'made': ticks at 1000 Hz, recorded at 10 Hz: ")
        assert "actions are held, no stream is faster than 130 Hz: check data.action_hz" in note

    @pytest.mark.usefixtures("extracted")
    def test_names_a_time_once_a_speed_is_known(self, changed):
        for sections in {"data": {"vlm_reuse_count": 2}}, {"vlm": {"prompt": "{images}"}}:
            _, said = run(changed(extract={"plan": True}, **sections))
            assert any("rows/s, as last measured" in line for line in said)

    def test_warns_where_one_recording_without_poses_decides_for_all(self, changed, monkeypatch):
        has_poses = property(lambda recording: "Press" not in str(recording.path))
        monkeypatch.setattr(WindowedRecording, "has_poses", has_poses)
        for rotation, count in (("auto", 1), ("euler_delta", 0)):
            _, said = run(changed(extract={"plan": True}, data={"action_rotation": rotation}))
            warnings = [line for line in said if line.startswith("WARNING: 1 of 3 episode(s)")]
            assert len(warnings) == count


class TestRefusals:
    def test_too_little_disk_is_refused_before_the_model(self, params, monkeypatch, no_model):
        monkeypatch.setattr("pipeline.extract.streams.free_bytes", lambda path: 1000)
        with pytest.raises(DiskFull, match=r"needs \d.*B, .* has \d.*B free"):
            run(params)
        assert not params.extract.store.exists()

    def test_lists_everything_that_is_wrong_at_once(self, params, recordings, no_model):
        npz = recordings / "Touch_dot/episode_1/sensor_data.npz"
        npz.write_bytes(npz.read_bytes()[:5000])
        image = sorted((recordings / "Press/episode_3/images/View2").iterdir())[3]
        image.write_bytes(image.read_bytes()[:300])
        with pytest.raises(RecordingError) as caught:
            run(params)
        text = str(caught.value)
        assert "2 of 3 episodes cannot be used" in text
        assert str(npz) in text
        assert str(image) in text
        assert "on_bad_episode=skip" in text

    @pytest.mark.parametrize("name", ["a\\b", "zarr.json"])
    def test_a_view_that_no_reader_of_a_store_would_take(self, params, recordings, no_model, name):
        episode = recordings / "Press/episode_3"
        (episode / "images/View2").rename(episode / "images" / name)
        metadata = json.loads((episode / "metadata.json").read_text())
        metadata["camera_views"] = []
        (episode / "metadata.json").write_text(json.dumps(metadata))
        with pytest.raises(RecordingError, match=r"1 of 3 .*\n.*episode_3: views\.0: .*found '"):
            run(params)

    def test_an_episode_whose_text_no_reader_of_a_store_would_take(
        self, params, monkeypatch, no_model
    ):
        monkeypatch.setattr(WindowedRecording, "group", "g" * 10_001)
        with pytest.raises(RecordingError, match=r"3 of 3 .*\n.*: group: expected a text to have"):
            run(params)

    def test_a_row_that_no_reader_would_take(self, params, monkeypatch, no_model):
        monkeypatch.setattr("pipeline.extract.streams.MOST_ROW_BYTES", 1000)
        with pytest.raises(ConfigError, match=r"a row of features would take.*vlm\.pooling"):
            run(params)
        assert not part_path(params.extract.store).exists()

    def test_skip_leaves_bad_episodes_out_and_lists_them_every_time(
        self, changed, recordings, no_model_later, counted, write_episode, monkeypatch
    ):
        bad = write_episode(recordings / "Press" / "episode_9", 9, views=("View9",))
        npz = bad / "sensor_data.npz"
        npz.write_bytes(npz.read_bytes()[:5000])
        params = changed(data={"on_bad_episode": "skip"})
        _, said = run(params)
        assert any(line.startswith("skipped made") and str(npz) in line for line in said)
        store = FeatureStore.open(params.extract.store)
        assert "episode_9" not in [one.id for one in store.episodes]
        assert store.streams["views"] == ["View1", "View2"], "it decides nothing"
        no_model_later()
        with monkeypatch.context() as patch:
            patch.delattr(Image, "open")
            report, said = run(params)
        assert report is None
        assert any(str(npz) in line for line in said)
        counted.clear()
        shutil.rmtree(bad)
        run(params)
        assert not counted, "to remove it changes no feature"

    @pytest.mark.usefixtures("extracted")
    def test_stop_stops_beside_a_finished_store_too(self, params, recordings):
        (recordings / "Press/episode_3/metadata.json").write_text("{")
        with pytest.raises(RecordingError, match=r"1 of 3 episodes.*\n.*metadata\.json"):
            run(params)

    def test_two_embodiments_are_refused_naming_both(
        self, changed, tmp_path, narrower, write_episode
    ):
        other = write_episode(tmp_path / "other" / "Task" / "episode_9", 9).parent.parent
        sources = [{"name": "made", "path": "."}, {"name": "second", "path": str(other)}]
        narrower(other)
        with pytest.raises(
            StoreMismatch, match=r"the sensor of source 'made'.*'second'.*7 channels.*two stores"
        ):
            run(changed(data={"sources": sources}))
