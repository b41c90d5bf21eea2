"""What a robot says is checked; a refusal names the field, what was expected and what was found."""

from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import ConfigError, ObservationError
from pipeline.robot.observation import KEY_MAPS, Doubts, ObservationReader
from pipeline.simulation.rendering import VIEWS
from tests.robot.conftest import SOURCE

METADATA = SOURCE | {"horizon": 4, "action_dim": 7, "stochastic": True}


def changed(array: np.ndarray, place: tuple[int, ...], value: float) -> np.ndarray:
    array = array.copy()
    array[place] = value
    return array


@pytest.fixture
def reader() -> ObservationReader:
    return ObservationReader(METADATA)


def test_what_is_whole_is_read(reader, observe) -> None:
    given = observe(0, reset=np.int64(3), prompt="go", **{"images_time/View5": np.float32(0.05)})
    given["state"] = given["state"].astype(">f8")
    given["time"] = 0.1
    guide = {"guide/chunk": np.zeros((4, 7)), "guide/weight": [1, 0.5, 0, 0]}
    read = reader.read(given | guide)
    assert (read.reset, read.seed, read.prompt, read.time_s) == (True, 3, "go", 0.1)
    assert read.readings["state"].dtype == np.float32 and read.readings["time"].shape == (1,)
    assert tuple(read.frames) == VIEWS and read.guide is not None
    np.testing.assert_allclose(read.frame_time_s, [0.1, 0.1, 0.05])


def test_whatever_is_missing_is_missing(reader) -> None:
    read = reader.read({"time": np.array([1.0])})
    assert set(read.readings) == {"time"} and read.frames == {} and read.guide is None
    assert np.isnan(read.frame_time_s).all() and (read.reset, read.seed) == (False, None)


def test_without_a_time_an_observation_is_of_its_newest_reading(reader, observe) -> None:
    last = observe(0)["sensor_time"][-1]
    timed = observe(0, time=None, **{"images_time/View5": last + 0.02})
    assert reader.read(timed).time_s == last + 0.02
    read = reader.read(observe(1, time=None))
    assert read.time_s == observe(1)["sensor_time"][-1]
    np.testing.assert_array_equal(read.frame_time_s, [read.time_s] * 3)
    with pytest.raises(ObservationError, match=r"^time: expected times from 0\.2"):
        reader.read({"state": STATE[:1], "state_time": [0.15]})


def test_without_any_time_an_observation_is_of_this_machines_clock(reader, monkeypatch) -> None:
    for now in (7.0, 7.5):
        monkeypatch.setattr("pipeline.robot.observation.monotonic", lambda now=now: now)
        read = reader.read({"state": STATE[:1], "images/View1": FRAME})
        assert read.time_s == now and read.readings["state_time"].tolist() == [now]
        assert read.frame_time_s[0] == now


def test_a_single_reading_without_its_time_is_of_the_observations(reader, observe) -> None:
    read = reader.read(observe(0, state=STATE[:1], state_time=None))
    assert read.readings["state_time"].tolist() == [0.1]
    for several in (STATE[:2], STATE[:0]):
        with pytest.raises(ObservationError, match="state_time: expected it beside state"):
            reader.read(observe(1, state=several, state_time=None))
    read = reader.read(observe(1, state=STATE[:0], state_time=[]))
    assert set(read.readings) == {"time", "sensor", "sensor_time"}, "without readings it is missing"


FRAME = np.zeros((4, 4, 3), np.uint8)
STATE, STATE_TIME = np.zeros((10, 12)), np.arange(1, 11) / 100


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"observation/state": STATE}, "observation/state: expected one of time, .*state_time"),
        ({"time": np.zeros(2)}, r"time: expected shape \(1\), found \(2,\)"),
        ({"state": np.zeros((10, 11))}, r"state: expected shape \(reading, 12\), found \(10, 11\)"),
        ({"state": [[1], [2, 3]]}, "state: expected numbers, found list"),
        ({"state": changed(STATE, (3, 2), np.nan)}, r"found nan at \(3, 2\)"),
        ({"state": changed(STATE, (0, 0), 1e300)}, r"found inf at \(0, 0\)"),
        ({"state_time": STATE_TIME[::-1]}, "state_time: expected times .*in order"),
        ({"state_time": STATE_TIME + 1}, r"state_time: expected times to 0\.1 s"),
        ({"images/View1": FRAME[:0]}, r"found shape \(0, 4, 3\)"),
        ({"images/View1": b"jpeg"}, "images/View1: expected an array, found bytes"),
        ({"images/View1": None, "images_time/View1": 0.0}, "images/View1: expected it beside"),
        ({"prompt": "x" * 1001}, "prompt: expected a text of at most 1000"),
        ({"reset": -1}, "reset: expected true, false or a seed"),
        ({"guide/chunk": np.zeros((4, 7))}, "guide/weight: expected numbers, found NoneType"),
        ({"guide/chunk": np.zeros((3, 7)), "guide/weight": np.zeros(4)}, r"found \(3, 7\)"),
        ({"guide/chunk": np.zeros((4, 7)), "guide/weight": np.full(4, 2)}, "expected 0 to 1"),
    ],
)
def test_what_is_wrong_is_refused_by_name_and_leaves_no_trace(reader, observe, wrong, said):
    with pytest.raises(ObservationError, match=said) as refused:
        reader.read(observe(0, **wrong))
    assert len(str(refused.value)) < 600
    reader.read(observe(0))


def test_what_has_no_fields_is_refused(reader) -> None:
    with pytest.raises(ObservationError, match="expected fields by name"):
        reader.read(np.zeros(3))


def test_observations_follow_one_another_until_a_reset(reader, observe) -> None:
    reader.read(observe(5))
    with pytest.raises(ObservationError, match=r"^time: .* reset where a new episode begins"):
        reader.read(observe(4))
    with pytest.raises(ObservationError, match=r"state_time: .*Send each reading once"):
        reader.read(observe(5) | {"time": 1.0})
    reader.read(observe(4, reset=True))
    reader.read(observe(5))


def test_what_the_policy_lacks_is_refused(observe) -> None:
    streams = METADATA["streams"] | {"sensor": {"names": []}}
    lacking = ObservationReader(METADATA | {"streams": streams, "stochastic": False})
    with pytest.raises(ObservationError, match=r"sensor: expected one of .*this policy"):
        lacking.read(observe(0))
    guide = {"guide/chunk": np.zeros((4, 7)), "guide/weight": np.zeros(4)}
    with pytest.raises(ObservationError, match=r"guide/chunk: expected one of .*this policy"):
        lacking.read(observe(0, sensor=None, sensor_time=None) | guide)


def test_what_cannot_be_true_is_doubted_once(reader, observe) -> None:
    doubts, state = Doubts(), np.zeros((1, 12))
    black = {"images/View1": np.zeros((4, 6, 3), np.uint8)}
    kept = {"images/View2": observe(0)["images/View2"]}
    new: list[list[str]] = []
    for tick in range(24):
        given = observe(tick, state=state, state_time=None, **black, **kept)
        doubts.look(reader.read(given))
        new.append(doubts.take())
    assert [text.split(":")[0] for text in new[0]] == ["images/View1", "state"]
    still = [text for texts in new[1:] for text in texts]
    assert [text.split(" for")[0] for text in still] == [
        f"images/{view}: the same picture" for view in ("View1", "View2")
    ]
    assert not any(new[1:20]), "two seconds"


def test_fields_may_be_nested_and_a_single_reading_has_no_axis(reader) -> None:
    flat = reader.read({"images/View1": FRAME, "state": STATE[:1], "time": 1.0})
    nested = reader.read({"images": {"View1": FRAME}, "state": STATE[0].tolist(), "time": 1.0})
    np.testing.assert_array_equal(nested.frames["View1"], flat.frames["View1"])
    np.testing.assert_array_equal(nested.readings["state"], flat.readings["state"])
    with pytest.raises(ObservationError, match=r"^images/View1: expected it once"):
        reader.read({"images": {"View1": FRAME}, "images/View1": FRAME})


OPENPI: dict[str, dict[str, Any]] = {
    "droid": {
        "observation/exterior_image_1_left": np.zeros((4, 6, 3), np.uint8),
        "observation/wrist_image_left": np.full((4, 6, 3), 7, np.uint8),
        "observation/joint_position": np.arange(7.0),
        "observation/gripper_position": np.array([7.0]),
    },
    "libero": {
        "observation/image": np.zeros((4, 6, 3), np.uint8),
        "observation/wrist_image": np.full((4, 6, 3), 7, np.uint8),
        "observation/state": np.arange(8.0),
    },
}
"""What openpi's examples of these robots send, beside the prompt."""


@pytest.mark.parametrize("robot", OPENPI)
def test_openpis_names_of_a_robot_are_translated(robot: str) -> None:
    streams = {"views": ["View1", "View2"], "state": {"names": ["j"] * 8}}
    given = OPENPI[robot] | {"prompt": "do something"}
    read = ObservationReader(METADATA | {"streams": streams}, KEY_MAPS[robot]).read(given)
    assert [frame.max() for frame in read.frames.values()] == [0, 7] and read.prompt
    assert read.readings["state"].tolist() == [[*range(8)]]
    with pytest.raises(ObservationError, match=r"set serve\.transform"):
        ObservationReader(METADATA | {"streams": streams}).read(given)


def test_what_does_not_fit_a_known_robot_is_refused() -> None:
    droid, given = KEY_MAPS["droid"], {"observation/joint_position": np.arange(7.0)}
    with pytest.raises(ObservationError, match=r"^observation/gripper_position: expected it"):
        droid.apply(given, ["View1"])
    given |= {"observation/gripper_position": np.zeros((2, 2))}
    with pytest.raises(ObservationError, match=r"^observation/joint_position .* of one reading"):
        droid.apply(given, ["View1"])
    with pytest.raises(ConfigError, match=r"serve\.transform: expected a policy of at most 2"):
        droid.refuse_more(["View1", "View2", "View3"])


def test_a_view_of_an_images_name_stays_that_view() -> None:
    aloha = KEY_MAPS["aloha"]
    sent = {name: np.full((4, 6, 3), place) for place, name in enumerate(aloha.images)}
    views = ["cam_high", "cam_left_wrist", "cam_low", "cam_right_wrist"]
    for known in (views, views[1:3]):
        taken = aloha.apply(sent, known)
        assert taken.keys() == {f"images/{view}" for view in known}
        assert all(taken[name] is sent[name] or (taken[name] == sent[name]).all() for name in taken)
    assert [image[0, 0, 0] for image in aloha.apply(sent, ["View1", "View2"]).values()] == [0, 1]
