"""What a robot did is what a recording of it says, to the reading, the pixel and the key."""

import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import Params, Source
from pipeline.base.digests import file_digest
from pipeline.base.errors import RecordingError
from pipeline.data import Recording, open_recordings
from pipeline.extract import extract
from pipeline.robot import recorder as recorder_module
from pipeline.robot.recorder import RunRecorder, encode_png, recover
from pipeline.simulation.environment import InsertionEnvironment
from pipeline.simulation.insertion import INSTRUCTION
from pipeline.simulation.rendering import VIEWS
from pipeline.store import FeatureStore
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.preparation import Preparer
from tests.robot.conftest import SOURCE

REUSE = 3
Frames = Mapping[str, tuple[float, np.ndarray]]


def metadata_of(**changed: Any) -> dict[str, Any]:
    """What a policy for the phantom says of itself, as far as a recorder reads it."""
    spec = {"digest": "d", "prompt": "p"}
    told = {"action_hz": 10.0, "feature_spec": spec, "feature_spec_digest": "d"}
    return told | {"streams": SOURCE["streams"] | changed}


@dataclass
class Driven:
    """What the loop of one run saw and sent, kept beside the recorder."""

    recorder: RunRecorder
    time: list[float] = field(default_factory=list)
    sent: list[np.ndarray] = field(default_factory=list)
    readings: dict[str, list[np.ndarray]] = field(default_factory=dict)
    looked: list[tuple[int, Frames, bytes]] = field(default_factory=list)


def drive(
    folder: Path,
    metadata: Mapping[str, Any],
    key_of: Callable[[Frames], bytes] = lambda frames: bytes(16),
    ticks: int | None = None,
) -> Driven:
    """The demonstrator's episode; every third tick is looked at."""
    environment = InsertionEnvironment("full")
    observed, _ = environment.reset(seed=11)
    driven = Driven(RunRecorder(folder, metadata, INSTRUCTION, {"execute": 1}))
    recorder, tick = driven.recorder, 0
    while not environment.insertion.finished and tick != ticks:
        if tick % REUSE == 0:
            frames = environment.frames()
            recorder.frames(frames)
            driven.looked.append((tick, frames, key := key_of(frames)))
            said = {"feature_key": np.frombuffer(key, np.uint8), "feature_age_s": 0.05}
            recorder.answer(said)
        action = environment.insertion.expert_action()
        recorder.tick(observed, action)
        for name in ("state", "state_time", "sensor", "sensor_time"):
            driven.readings.setdefault(name, []).append(observed[name])
        driven.sent.append(action.astype(np.float32))
        driven.time.append(float(observed["time"][0]))
        observed = environment.step(action)[0]
        tick += 1
    return driven


def opened(folder: Path) -> Recording:
    (recording,) = open_recordings([Source(name="runs", path=str(folder))], folder).recordings
    return recording


def end_of(path: Path) -> dict[str, Any]:
    return json.loads((path / "run.json").read_text())


def shades(camera: Any) -> list[int]:
    """The first pixel of each of its frames."""
    return [frame[0, 0, 0] for frame in camera.read(range(len(camera.time)))]


@pytest.fixture(scope="module")
def run(demo_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory):
    """A whole run, its recording, and the store that is extracted from it."""
    folder = tmp_path_factory.mktemp("run")
    size = {"image_resize_height": 56, "image_resize_width": 56}
    vlm = {"checkpoint": str(demo_checkpoint), "dtype": "float32", "pooling": ["mean"], **size}
    data = {"root": str(folder), "sources": [{"name": "runs", "path": "runs"}]}
    document = {"data": data | {"vlm_reuse_count": REUSE}, "vlm": vlm}
    params = Params.model_validate(document | {"extract": {"store": str(folder / "runs.zarr")}})
    spec = feature_spec(params.vlm, "float32", VIEWS, file_digest)
    preparer = Preparer(params.vlm, spec)

    def key_of(frames: Frames) -> bytes:
        seen = {view: image for view, (_, image) in frames.items()}
        return spec.row_key(preparer.render(INSTRUCTION, list(seen)), seen)

    told = {"feature_spec": spec.attrs(), "feature_spec_digest": spec.digest}
    driven = drive(folder / "runs", metadata_of() | told, key_of)
    path = driven.recorder.finish("inserted", {"tick_ms": {"p50": 1.5}})
    extract(params, say=lambda _: None)
    return driven, path, FeatureStore.open(folder / "runs.zarr")


def test_a_run_comes_back_as_it_was_and_says_how_it_ended(run) -> None:
    driven, path, _ = run
    recording = opened(path)
    action, start = recording.action(), driven.time[0]
    assert action is not None and action.kind == "delta"
    np.testing.assert_array_equal(action.values, np.stack(driven.sent))
    np.testing.assert_array_equal(action.time, np.array(driven.time) - start)
    for name, stream in (("state", recording.state()), ("sensor", recording.sensor())):
        values, times = (np.concatenate(driven.readings[key]) for key in (name, f"{name}_time"))
        np.testing.assert_array_equal(stream.values, values.astype(np.float32))
        np.testing.assert_array_equal(stream.time, times - start)
    for view, camera in recording.cameras().items():
        shots = [frames[view] for _, frames, _ in driven.looked]
        np.testing.assert_array_equal(camera.time, np.array([time for time, _ in shots]) - start)
        read = camera.read(range(len(shots)))
        for (_, shot), frame in zip(shots, read, strict=True):
            np.testing.assert_array_equal(frame, shot)
    assert (recording.instruction, sorted(recording.cameras())) == (INSTRUCTION, list(VIEWS))
    said = end_of(path)
    assert (said["reason"], said["settings"]) == ("inserted", {"execute": 1})
    assert said["timings"] == {"tick_ms": {"p50": 1.5}}
    assert said["rows"] == said["ticks"] == len(driven.sent)
    assert (said["start_s"], said["dropped_images"]) == (driven.time[0], 0)
    assert not list(path.parent.glob("*.part"))
    with np.load(path / "features" / "episode_000000.npz") as features:
        assert features["key"].shape == (len(driven.sent), 16)
        assert features["age_s"][0] == np.float32(0.05)
        assert features["feature_spec_digest"] == [said["metadata"]["feature_spec_digest"]]


def test_a_store_of_a_run_has_its_actions_its_clocks_and_the_robots_keys(run) -> None:
    driven, _, store = run
    start = driven.time[0]
    np.testing.assert_array_equal(store.array("tick/action"), np.stack(driven.sent))
    np.testing.assert_allclose(store.array("tick/time"), np.array(driven.time) - start, atol=1e-9)
    keys = [key for _, _, key in driven.looked]
    assert [row.tobytes() for row in store.array("vl/key")] == keys
    captured = [[frames[view][0] - start for view in VIEWS] for _, frames, _ in driven.looked]
    np.testing.assert_array_equal(store.array("vl/frame_time"), captured)
    assert len(np.concatenate(driven.readings["state"])) == len(store.array("state/values"))


def observed_at(tick: int, **readings: Any) -> dict[str, Any]:
    return {"time": np.array([5 + tick / 10]), **readings}


def state_at(tick: int, value: float = 1.0) -> dict[str, Any]:
    return {"state": np.full((1, 12), value), "state_time": np.array([5 + tick / 10])}


def image_of(shade: int) -> np.ndarray:
    return np.full((6, 8, 3), shade, np.uint8)


NONE: dict[str, Any] = {"names": [], "units": []}


def test_streams_that_the_policy_lacks_are_not_recorded(tmp_path) -> None:
    path = drive(tmp_path, metadata_of(sensor=NONE), ticks=5).recorder.finish("done")
    recording = opened(path)
    assert recording.sensor() is None and recording.state() is not None
    recorder = RunRecorder(tmp_path, metadata_of(state=NONE, sensor=NONE, views=[]), "Push")
    for tick in range(4):
        recorder.tick(observed_at(tick), np.full(7, tick))
    recording = opened(recorder.finish("done"))
    assert recording.action().values[:, 0].tolist() == [0, 1, 2, 3]
    assert recording.state() is None and not recording.cameras()


def test_rows_begin_when_all_streams_have_and_a_view_that_never_came_is_missing(tmp_path) -> None:
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    for tick in range(6):
        if tick == 3:
            recorder.frames({"View1": (5.3, image_of(7)), "Side": (5.3, image_of(9))})
        action = None if tick in (0, 4) else np.full(7, tick)  # no chunk yet, or one was missing
        recorder.tick(observed_at(tick, **(state_at(tick) if tick else {})), action)
    path = recorder.finish("done")
    recording = opened(path)
    assert recording.action().values[:, 0].tolist() == [3, 5]
    assert end_of(path)["start_s"] == 5.3 and list(recording.cameras()) == ["View1"]


def test_a_frame_is_no_newer_than_the_tick_that_it_came_with(tmp_path) -> None:
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    for tick in range(4):
        if tick % 2 == 0:
            recorder.frames({"View1": (5.004 + tick / 10, image_of(tick))})
        recorder.frames({"View1": (5.0, image_of(99))})  # an older one, which is passed over
        recorder.tick(observed_at(tick), np.zeros(7))
    camera = opened(recorder.finish("done")).cameras()["View1"]
    np.testing.assert_allclose(camera.time, [0, 0.2])
    assert shades(camera) == [0, 2]


def test_equal_images_are_stored_once(tmp_path) -> None:
    sizes: list[int] = []
    noise = np.random.default_rng(0).integers(0, 256, (80, 100, 3), np.uint8)
    for looks, images in ((range(20), 1), (range(0, 20, 3), 4), (range(20), 20)):
        recorder = RunRecorder(tmp_path, metadata_of(), "Push")
        for tick in range(20):
            if tick in looks:
                recorder.frames({"View1": (5 + tick / 10, np.roll(noise, tick % images))})
            recorder.tick(observed_at(tick), np.zeros(7))
        (data,) = recorder.finish("done").glob("data/*/*.parquet")
        sizes.append(data.stat().st_size)
    np.testing.assert_allclose(np.array(sizes) / noise.nbytes, [1, 4, 20], rtol=0.15)


def test_readings_that_are_no_numbers_are_left_out(tmp_path) -> None:
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    state = np.arange(48, dtype=np.float32).reshape(4, 12)
    state[1, 3], state[2, 0] = np.nan, np.inf
    times = {"state_time": 5 + np.arange(4) / 100}
    recorder.tick(observed_at(1, state=state, **times), np.zeros(7))
    # What a clock that stops the robot brings last: of before, and of no time at all.
    late = {"state": state[:2] * 0, "state_time": np.array([4.0, np.nan])}
    recorder.tick(observed_at(2, **late), None)
    path = recorder.finish("safe stop: the state is not a number")
    np.testing.assert_array_equal(opened(path).state().values, state[[0, 3]])


def test_images_that_find_no_room_are_dropped_and_counted(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(recorder_module, "MOST_IMAGE_BYTES", 2 * image_of(0).nbytes + 1)
    go = threading.Event()

    def slow(image: np.ndarray) -> bytes:
        go.wait()
        return encode_png(image)

    monkeypatch.setattr(recorder_module, "encode_png", slow)
    metadata = metadata_of(state=NONE, sensor=NONE, views=["View1"])
    recorder = RunRecorder(tmp_path, metadata, "Push")
    recorder.frames({"View1": (5.0, image_of(0))})
    recorder.tick(observed_at(0), np.zeros(7))
    for tick in range(1, 5):
        recorder.frames({"View1": (5 + tick / 10, image_of(tick))})
        recorder.tick(observed_at(tick), np.zeros(7))
    go.set()
    camera = opened(path := recorder.finish("done")).cameras()["View1"]
    assert (end_of(path)["rows"], end_of(path)["dropped_images"]) == (5, 4)
    assert shades(camera) == [0]


def test_a_disk_that_does_not_keep_up_fails_the_recording_not_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "MOST_BYTES", 100)
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    for tick in range(3):
        recorder.tick(observed_at(tick), np.zeros(7))
        recorder.tick(observed_at(tick, state=np.ones((9, 12)), state_time=np.ones(9)), None)
    assert recorder.failed is not None and "does not keep up" in recorder.failed
    with pytest.raises(RecordingError, match="does not keep up"):
        recorder.finish("done")


def test_what_the_loop_gives_wrongly_fails_the_recording_not_the_run(tmp_path) -> None:
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    recorder.tick(observed_at(0), np.zeros(7))
    recorder.tick(observed_at(1), np.zeros(3))
    recorder.tick({}, np.zeros(7))
    recorder.frames({"View1": (5.0, image_of(0)[0])})
    recorder.answer({"feature_key": np.zeros(5)})
    assert recorder.failed is not None and "shape" in recorder.failed
    with pytest.raises(RecordingError, match=r"run_000000\.part: the recording of this run is not"):
        recorder.finish("done")
    assert recover(recorder.part).name == "run_000000"


def test_a_recording_is_one_episode(tmp_path) -> None:
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    for tick in range(4):
        recorder.tick(observed_at(tick % 3, reset=tick % 3 == 0), np.full(7, tick))
    with pytest.raises(RecordingError, match="another episode begins"):
        recorder.finish("done")
    assert opened(recover(recorder.part)).action().values[:, 0].tolist() == [0, 1, 2]


def test_a_run_that_stops_before_its_first_action_is_recorded(tmp_path) -> None:
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    for tick in range(4):
        if tick == 1:
            recorder.frames({"View1": (5.1, image_of(7))})
        recorder.tick(observed_at(tick, **state_at(tick, tick)), None)
    recorder.tick({"time": np.array([0.0])}, None)  # a clock that stopped the robot
    path = recorder.finish("step of kLeftElbow would be 1.231, at most 0.2")
    recording, said = opened(path), end_of(path)
    assert recording.state().values[:, 0].tolist() == [0, 1, 2, 3]
    assert shades(recording.cameras()["View1"]) == [7]
    assert (said["rows"], said["ticks"]) == (3, 5) and said["reason"].startswith("step of")
    with pytest.raises(RecordingError, match="no feature 'action'"):
        recording.action()


def test_a_run_without_an_observation_is_no_recording_and_a_finished_one_not_recovered(tmp_path):
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    with pytest.raises(RecordingError, match="the robot was never observed"):
        recorder.finish("the robot's code failed")
    assert recorder.part.is_dir()
    for name in ("run_000007", "run_000009.part", "else"):
        (tmp_path / name).mkdir()
    recorder = RunRecorder(tmp_path, metadata_of(), "Push")
    recorder.tick(observed_at(0), np.zeros(7))
    path = recorder.finish("done")
    assert path == tmp_path / "run_000010", "runs are numbered after those there"
    with pytest.raises(RecordingError, match=r"expected what is left of a run, run_NNNNNN\.part"):
        recover(path)
    assert opened(path).action() is not None
