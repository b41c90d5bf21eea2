"""The timeline: causal, covered by every stream, actions as the conventions say."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.base.errors import ConfigError, RecordingError
from pipeline.data import CameraStream, Channels, RecordedAction, Recording, Stream
from pipeline.data.timeline import build_timeline, choose_action_rotation, rounding, wrapped_deg

POSE = Channels(("x", "y", "z", "a", "b", "r"), ("mm",) * 3 + ("deg",) * 3)
EULER = Channels(
    ("dx", "dy", "dz", "da", "db", "dr", "gripper"), ("mm",) * 3 + ("deg",) * 3 + ("",)
)
JOINTS = Channels(("j0_vel", "j1_vel"), ("", ""))


class Camera(CameraStream):
    def __init__(self, view: str, time: NDArray[np.float64]) -> None:
        self.view, self.time = view, time

    def check(self, indices: Sequence[int]) -> None:
        raise AssertionError("a timeline looks at no pixel")

    def read(self, indices: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        raise AssertionError("a timeline looks at no pixel")


@dataclass
class Made(Recording):
    """A recording made of what it is given."""

    camera_times: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    recorded: RecordedAction | None = None
    pose: Stream | None = None
    path: Path = Path("made")

    _views: None = None

    def files(self) -> list[Path]:
        return []

    def all_views(self) -> Sequence[str]:
        return list(self.camera_times)

    def _recorded_instruction(self) -> str:
        return "touch"

    def _cameras(self) -> Mapping[str, CameraStream]:
        return {view: Camera(view, time) for view, time in self.camera_times.items()}

    def action(self) -> RecordedAction | None:
        return self.recorded

    @property
    def has_poses(self) -> bool:
        return self.pose is not None

    def poses(self) -> Stream | None:
        return self.pose


def recorded_at(time: NDArray[np.float64], kind: str = "delta", rate: float | None = 10.0):
    values = np.arange(len(time) * 2, dtype=np.float32).reshape(-1, 2)
    return RecordedAction(JOINTS, time, values, kind, rate)


def matrix(a: float, b: float, r: float) -> NDArray[np.float64]:
    """Rx(a)·Ry(b)·Rz(r), written out."""
    a, b, r = np.radians([a, b, r])
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    return x @ y @ z


class TestRecordedTicks:
    @pytest.mark.parametrize("action_hz", [None, 9.1, 10.9])
    def test_are_the_jittered_rows_within_a_tenth_of_the_rate(self, action_hz):
        time = np.cumsum(np.random.default_rng(0).uniform(0.08, 0.12, 30))
        line = build_timeline(Made(recorded=recorded_at(time)), action_hz, 3, "euler_delta")
        assert np.array_equal(line.time, time)
        assert np.array_equal(line.action[:, 0], np.arange(30) * 2)

    def test_are_held_at_another_rate(self):
        recorded = recorded_at(np.arange(20) / 10, "velocity")
        line = build_timeline(Made(recorded=recorded), 25.0, 3, "euler_delta")
        assert np.allclose(np.diff(line.time), 0.04)
        assert np.array_equal(line.action[:, 0], 2 * np.floor(line.time * 10 + 1e-9))

    @pytest.mark.parametrize(
        "time",
        [
            (1.7e9 + np.arange(20) / 10) * 1e3,
            np.append(np.arange(20) / 10, 1e12),  # more ticks than an episode can have
        ],
    )
    def test_refuse_clocks_that_are_not_in_seconds(self, time):
        recorded = recorded_at(time, "absolute", None)
        with pytest.raises(RecordingError, match="made: are the clocks in seconds"):
            build_timeline(Made(recorded=recorded), 25.0, 3, "euler_delta")

    def test_take_the_rate_from_the_clock_where_none_is_named(self):
        recorded = recorded_at(np.arange(20) / 20, rate=None)
        assert len(build_timeline(Made(recorded=recorded), 20.0, 3, "euler_delta").time) == 20
        with pytest.raises(RecordingError, match=r"made: its actions.*20 Hz.*action_hz=10"):
            build_timeline(Made(recorded=recorded), 10.0, 3, "euler_delta")


def regular(offset_s: float, rate_hz: float, entries: int, dtype: str) -> NDArray[np.float64]:
    """A clock of equal steps as a recorder of that type stores it."""
    return (offset_s + np.arange(entries) / rate_hz).astype(dtype).astype(np.float64)


@st.composite
def clocks(draw) -> tuple[str, float]:
    """A stored type, and an offset at which it still tells milliseconds apart."""
    dtype = draw(st.sampled_from(["float32", "float64"]))
    return dtype, draw(st.floats(-500, 500 if dtype == "float32" else 100_000))


class TestRegularRecordings:
    @given(
        clock=clocks(),
        action_hz=st.sampled_from([1, 2, 3, 5, 7.5, 10, 15, 20, 25, 30, 50]),
        factor=st.integers(2, 10),
        fast=st.integers(1, 4),
        ticks=st.integers(1, 200),
        reuse=st.integers(1, 5),
    )
    def test_resampled_by_a_whole_factor_give_the_exact_rows(
        self, clock, action_hz, factor, fast, ticks, reuse
    ):
        dtype, offset = clock
        rows = (ticks - 1) * factor + 1
        time = regular(offset, action_hz * factor, rows, dtype)
        readings = regular(offset, action_hz * factor * fast, (rows - 1) * fast + 1, dtype)
        sensor = Stream(JOINTS, readings, np.zeros((len(readings), 2), np.float32))
        recorded = recorded_at(time, "absolute", action_hz * factor)
        made = Made(camera_times={"View1": time}, recorded=recorded)
        state = Stream(JOINTS, time, recorded.values)
        line = build_timeline(made, action_hz, reuse, "euler_delta", state, sensor)
        expected = np.arange(ticks) * factor
        assert np.array_equal(line.action, recorded.values[expected])
        assert np.array_equal(line.frames["View1"], expected[::reuse])
        assert np.array_equal(line.state_end, expected + 1)
        assert np.array_equal(line.sensor_end, expected * fast + 1)

    @given(clock=clocks(), rate=st.sampled_from([10, 30, 100]), rows=st.integers(1, 300))
    def test_at_their_own_rate_see_streams_that_were_stored_otherwise(self, clock, rate, rows):
        dtype, offset = clock
        stored = regular(offset, rate, rows, dtype)
        exact = regular(offset, rate, rows, "float64")
        sensor = Stream(JOINTS, exact, np.zeros((rows, 2), np.float32))
        line = build_timeline(
            Made(recorded=recorded_at(stored, rate=rate)), None, 3, "euler_delta", sensor=sensor
        )
        assert np.array_equal(line.time, stored)
        assert np.array_equal(line.sensor_end, np.arange(rows) + 1)


class TestCoverage:
    def test_counts_sensor_and_state(self):
        time = np.arange(100) / 10
        sensor = Stream(JOINTS, 0.55 + np.arange(50) / 50, np.zeros((50, 2), np.float32))
        line = build_timeline(
            Made(recorded=recorded_at(time)), 10.0, 3, "euler_delta", sensor=sensor
        )
        assert line.time[0] == pytest.approx(0.6)
        assert line.time[-1] == pytest.approx(1.5)
        assert line.sensor_end[0] == 3
        assert not line.state_end.any()

    def test_says_which_streams_never_meet(self):
        made = Made(
            camera_times={"View1": np.arange(20.0, 30.0)},
            recorded=recorded_at(np.arange(10) / 10),
        )
        with pytest.raises(RecordingError, match=r"view View1 begins at 20.*action has ended"):
            build_timeline(made, 10.0, 3, "euler_delta")


class TestReuse:
    @given(
        ticks=st.integers(1, 60),
        reuse=st.integers(1, 9),
        frames=st.lists(st.floats(0, 6), min_size=1, max_size=30),
    )
    def test_every_frame_is_the_last_at_or_before_its_row(self, ticks, reuse, frames):
        camera = np.sort([0.0, *frames])
        camera = np.append(camera, 1e3)
        made = Made(camera_times={"View1": camera}, recorded=recorded_at(np.arange(ticks) / 10))
        line = build_timeline(made, 10.0, reuse, "euler_delta")
        assert len(line.vl_time) == -(-ticks // reuse)
        assert np.array_equal(line.vl_row, np.arange(ticks) // reuse)
        assert np.array_equal(line.vl_time, line.time[::reuse])
        shown, slack = line.frames["View1"], max(rounding(camera), rounding(line.time))
        assert (camera[shown] <= line.vl_time + slack).all()
        assert (camera[shown + 1] > line.vl_time).all()
        assert np.array_equal(line.frame_time["View1"], camera[shown])


class TestPoseActions:
    def poses(self, values: NDArray[np.float64], hz: float = 100.0) -> Stream:
        return Stream(POSE, 5.0 + np.arange(len(values)) / hz, values.astype(np.float32))

    def test_translation_is_the_difference_in_the_base_frame(self):
        values = np.zeros((101, 6))
        values[:, 0] = np.linspace(0, 10, 101)
        values[:, 3:] = [30, 40, 50]
        line = build_timeline(Made(pose=self.poses(values)), 10.0, 3, "rotvec")
        assert len(line.time) == 10, "the last tick still has a following pose"
        assert np.allclose(line.action, [1, 0, 0, 0, 0, 0, 1], atol=1e-4)
        assert line.action_channels.names == ("dx", "dy", "dz", "rx", "ry", "rz", "gripper")

    @given(
        start=st.tuples(st.floats(-180, 180), st.floats(-80, 80), st.floats(-180, 180)),
        stop=st.tuples(st.floats(-180, 180), st.floats(-80, 80), st.floats(-180, 180)),
    )
    def test_rotvec_turns_one_pose_into_the_next(self, start, stop):
        values = np.zeros((2, 6))
        values[0, 3:], values[1, 3:] = start, stop
        made = Made(pose=self.poses(values, hz=10.0))
        line = build_timeline(made, 10.0, 1, "rotvec")
        turn = Rotation.from_rotvec(line.action[0, 3:6], degrees=True).as_matrix()
        turned = turn @ matrix(*np.float32(start))
        assert np.allclose(turned, matrix(*np.float32(stop)), atol=1e-4)

    def test_euler_delta_is_wrapped(self):
        values = np.zeros((21, 6))
        values[:, 5] = (179.0 + 0.2 * np.arange(21) + 180) % 360 - 180
        line = build_timeline(Made(pose=self.poses(values)), 10.0, 3, "euler_delta")
        assert np.allclose(line.action[:, 5], 2.0, atol=1e-4)
        assert line.action_channels == EULER

    def test_needs_a_rate(self):
        with pytest.raises(ConfigError, match="action_hz"):
            build_timeline(Made(pose=self.poses(np.zeros((50, 6)))), None, 3, "rotvec")

    def test_refuses_poses_of_one_instant(self):
        # A tenth of a second is lost in a float64 of nanoseconds.
        pose = Stream(POSE, np.full(50, 1.7e18), np.zeros((50, 6), np.float32))
        with pytest.raises(RecordingError, match=r"made: its 50 pose\(s\) stand at one instant"):
            build_timeline(Made(pose=pose), 10.0, 3, "rotvec")

    def test_too_short_for_a_following_pose(self):
        with pytest.raises(RecordingError, match="too short"):
            build_timeline(Made(pose=self.poses(np.zeros((5, 6)))), 10.0, 3, "rotvec")


class TestActionRotation:
    def pose(self) -> Stream:
        return Stream(POSE, np.arange(50) / 10, np.zeros((50, 6), np.float32))

    def old(self, pose: Stream | None) -> Made:
        values = np.ones((20, 7), np.float32)
        return Made(
            recorded=RecordedAction(EULER, np.arange(20) / 10, values, "delta", 10.0), pose=pose
        )

    def test_auto_is_rotvec_only_where_every_recording_has_poses(self):
        with_poses, without = self.old(self.pose()), self.old(None)
        assert choose_action_rotation("auto", [with_poses]) == "rotvec"
        assert choose_action_rotation("auto", [with_poses, without]) == "euler_delta"
        assert choose_action_rotation("rotvec", [without]) == "rotvec"

    def test_recorded_euler_deltas_are_kept_under_euler_delta(self):
        line = build_timeline(self.old(self.pose()), 10.0, 3, "euler_delta")
        assert (line.action == 1).all()

    def test_recorded_euler_deltas_are_derived_anew_under_rotvec(self):
        line = build_timeline(self.old(self.pose()), 10.0, 3, "rotvec")
        assert line.action_channels.names[3:6] == ("rx", "ry", "rz")
        assert (line.action[:, :6] == 0).all()


@given(st.floats(-1e4, 1e4))
def test_wrapped_is_the_same_angle(degrees):
    inside = wrapped_deg(np.array([degrees]))[0]
    assert -180 <= inside < 180
    assert np.isclose(np.cos(np.radians(inside)), np.cos(np.radians(degrees)), atol=1e-6)


def test_times_since_1970_are_compared_as_they_are():
    """Or stores of recordings on such clocks would be others than those that are there."""
    time = 1762581333.4 + np.arange(20) / 10
    late = np.nextafter(time, np.inf)
    recorded = recorded_at(time)
    line = build_timeline(
        Made(camera_times={"View1": np.append(time[0], late)}, recorded=recorded),
        10.0,
        1,
        "euler_delta",
    )
    assert np.array_equal(line.frames["View1"], np.arange(20))


@pytest.mark.parametrize(
    ("clock", "slack"),
    [
        ([1762581333.1, 1762581333.2], 1e-9),
        ([0.1, 0.2], 1e-9),
        (np.float32([0.1, 8.1]), 2 * 2.0**-20),  # two of a float32
        ([0.0, 2.0**40], 1e-3),
    ],
)
def test_times_are_the_same_within_the_rounding_of_what_stored_them(clock, slack):
    assert rounding(np.array(clock, np.float64)) == slack


@pytest.mark.parametrize(
    ("nominal", "actual", "action_hz"), [(10.0, 30.0, 10.0), (30.0, 10.0, None)]
)
def test_a_rate_that_contradicts_the_clock_is_refused(nominal, actual, action_hz):
    recording = Made(recorded=recorded_at(np.arange(20) / actual, "absolute", nominal))
    match = rf"made: .* say {nominal:g} Hz .*which is {actual:g} Hz"
    with pytest.raises(RecordingError, match=match):
        build_timeline(recording, action_hz, 3, "euler_delta")
