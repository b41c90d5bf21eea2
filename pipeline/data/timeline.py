"""Clocks -> ticks: the frames, readings, action and VL row of each tick.

All times are float64 seconds on the recording's own clock. Ticks begin when every stream of the
episode has begun, and end when one ends. Everything that a tick sees is at or before it; only its
action lies ahead. An entry that is at most `rounding` later than a tick counts as at the tick.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ConfigError, RecordingError
from pipeline.base.provenance import RATE_TOLERANCE
from pipeline.data import Channels, RecordedAction, Recording, Stream

ActionRotation = Literal["rotvec", "euler_delta"]

FINEST_S, COARSEST_S = 1e-9, 1e-3
"""Bounds of `rounding`: sums of steps in float64 are off by more than their last digit, and a
reading more than a millisecond after a tick is always later than it."""

_MOST_TICKS = 1_000_000  # per episode: 28 hours at 10 Hz
_SLOWEST_HZ = 0.66  # of an episode's fastest stream: 650 Hz in milliseconds looks like 0.65 Hz

_TRANSLATION = ("dx", "dy", "dz")
_ROTATION = {"rotvec": ("rx", "ry", "rz"), "euler_delta": ("da", "db", "dr")}

_Clocks = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Timeline:
    """An episode's ticks; indices are into its own streams."""

    time: NDArray[np.float64]
    """(tick,) s."""
    action: NDArray[np.float32]
    """(tick, action_dim) in physical units."""
    action_channels: Channels
    action_kind: str
    recorded_hz: float | None
    """Rate of the recorded actions; None for a single action or actions derived from poses."""
    fastest_hz: float
    """Rate of the episode's fastest stream."""
    vl_row: NDArray[np.int64]
    """(tick,) the VL row that each tick uses."""
    vl_time: NDArray[np.float64]
    """(vl_row,) s, the tick each VL row is computed for."""
    frames: Mapping[str, NDArray[np.int64]]
    """View -> (vl_row,) the last frame at or before `vl_time`."""
    frame_time: Mapping[str, NDArray[np.float64]]
    """View -> (vl_row,) s, the capture time of that frame."""
    sensor_end: NDArray[np.int64]
    """(tick,) one past the last sensor reading at or before the tick; 0 without a sensor."""
    state_end: NDArray[np.int64]
    """(tick,) one past the last state at or before the tick; 0 without a state."""
    slack_s: float
    """Most seconds that an entry of a clock may be later than a tick and still count as at it."""

    def frame_times(self, views: Sequence[str]) -> NDArray[np.float64]:
        """Capture times (vl_row, view) s; NaN where the episode lacks the view."""
        missing = np.full(len(self.vl_time), np.nan)
        columns = [self.frame_time.get(view, missing) for view in views]
        return np.stack(columns, axis=1) if columns else np.zeros((len(self.vl_time), 0))


def build_timeline(
    recording: Recording,
    action_hz: float | None,
    vlm_reuse_count: int,
    action_rotation: ActionRotation,
    state: Stream | None = None,
    sensor: Stream | None = None,
) -> Timeline:
    """The ticks of one episode.

    `state` and `sensor` are the recording's own streams, which the caller has read. Raises
    `RecordingError` where there are no actions, no instant is covered by every stream, clocks are
    not in seconds or contradict the metadata's rate, or delta actions would need resampling, and
    `ConfigError` where actions are derived from poses and `action_hz` is None.
    """
    cameras = recording.cameras()
    clocks = {f"view {view}": camera.covered for view, camera in cameras.items()}
    streams = {"sensor": sensor, "state": state}
    clocks |= {name: stream.time for name, stream in streams.items() if stream}
    recorded = recording.action()
    poses = recording.poses()
    rate: float | None = None
    # As rotation vectors, recorded Euler deltas are derived again from poses.
    euler = recorded is not None and recorded.channels == pose_channels("euler_delta")
    if recorded is not None and not (poses and euler and action_rotation == "rotvec"):
        clocks["action"] = recorded.time
        rate = _recorded_hz(recording, recorded)
        time, action = _recorded_ticks(recording, recorded, rate, clocks, action_hz)
        channels, kind = recorded.channels, recorded.kind
    elif poses is not None:
        clocks["pose"] = poses.time
        time, action = _pose_ticks(recording, poses, clocks, action_hz, action_rotation)
        channels, kind = pose_channels(action_rotation), "delta"
    else:
        raise RecordingError(f"{recording.path}: neither actions nor poses to derive them from")
    vl_time = time[::vlm_reuse_count]
    slack = _slack(clocks)
    frames = {view: last_at(camera.time, vl_time, slack) for view, camera in cameras.items()}
    none = np.zeros(len(time), np.int64)
    return Timeline(
        time=time,
        action=action,
        action_channels=channels,
        action_kind=kind,
        recorded_hz=rate,
        fastest_hz=max(map(_hz, clocks.values())),
        vl_row=np.arange(len(time)) // vlm_reuse_count,
        vl_time=vl_time,
        frames=frames,
        frame_time={view: cameras[view].time[rows] for view, rows in frames.items()},
        sensor_end=none if sensor is None else last_at(sensor.time, time, slack) + 1,
        state_end=none if state is None else last_at(state.time, time, slack) + 1,
        slack_s=slack,
    )


def choose_action_rotation(
    rotation: Literal["auto", "rotvec", "euler_delta"], recordings: Sequence[Recording]
) -> ActionRotation:
    """The requested convention; `auto` is rotvec if every recording has poses, else Euler."""
    if rotation != "auto":
        return rotation
    return "rotvec" if all(recording.has_poses for recording in recordings) else "euler_delta"


def last_at(
    clock: NDArray[np.float64], times: NDArray[np.float64], slack_s: float = 0.0
) -> NDArray[np.int64]:
    """For each time, the index of the last entry of a sorted clock at or before it; -1 for none.

    An entry up to `slack_s` later counts as at the time.
    """
    return np.searchsorted(clock, times + slack_s, side="right") - 1


def rounding(clock: NDArray[np.float64]) -> float:
    """Most seconds by which two times on a clock may differ and still be the same time.

    Two steps of float32 if all entries are float32 numbers; else a nanosecond, which has no effect
    on seconds since 1970.
    """
    narrow = clock.astype(np.float32)
    if not np.array_equal(clock, narrow):
        return FINEST_S
    return float(np.clip(2 * float(np.spacing(np.abs(narrow).max())), FINEST_S, COARSEST_S))


def rate_notes(
    rates: Iterable[tuple[str, float | None, float]], action_hz: float | None
) -> dict[str, str]:
    """For each source whose ticks have another rate than its actions, what happens to the actions.

    `rates` has source, `recorded_hz` and `fastest_hz` of each episode's timeline.
    """
    notes: dict[str, str] = {}
    for source, recorded_hz, fastest_hz in rates:
        if action_hz is None:
            continue
        why: list[str] = []
        if recorded_hz and abs(action_hz - recorded_hz) > RATE_TOLERANCE * recorded_hz:
            fate = "held" if action_hz > recorded_hz else "left out between ticks"
            why.append(f"recorded at {recorded_hz:.3g} Hz: actions are {fate}")
        if action_hz > (1 + RATE_TOLERANCE) * fastest_hz:
            why.append(f"no stream is faster than {fastest_hz:.3g} Hz: check data.action_hz")
        if why:
            notes[source] = f"ticks at {action_hz:g} Hz, {', '.join(why)}"
    return notes


def tick_hz(recorded_hz: Iterable[float | None], action_hz: float | None) -> float | None:
    """Ticks per second: `action_hz`, or the median rate of the recordings where it is None.

    `recorded_hz` has the rate of each episode's timeline. Returns None where no episode has a rate.
    """
    rates = [hz for hz in recorded_hz if hz]
    if action_hz is not None or not rates:
        return action_hz
    return float(f"{np.median(rates):.5g}")  # the digits that a float32 clock can tell


def wrapped_deg(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same angles in [-180, 180)."""
    return (angle + 180.0) % 360.0 - 180.0


def pose_channels(action_rotation: ActionRotation) -> Channels:
    """The channels of actions that are derived from poses."""
    names = (*_TRANSLATION, *_ROTATION[action_rotation], "gripper")
    return Channels(names, ("mm",) * 3 + ("deg",) * 3 + ("",))


def _recorded_hz(recording: Recording, recorded: RecordedAction) -> float | None:
    """Rate of the recorded actions, on which metadata and clock must agree; None for one action."""
    nominal, measured = recorded.rate_hz, _hz(recorded.time)
    if nominal and measured:
        # Jitter moves a short episode's median and a gap moves the mean, so both must differ.
        mean = (len(recorded.time) - 1) / float(recorded.time[-1] - recorded.time[0])
        if all(abs(nominal - hz) > RATE_TOLERANCE * nominal for hz in (measured, mean)):
            raise RecordingError(
                f"{recording.path}: its metadata say {nominal:g} Hz (LeRobot: fps in "
                f"meta/info.json), and its actions are {1 / measured:.4g} s apart, which is "
                f"{measured:.4g} Hz. Correct whichever is wrong: with both, no action has a known "
                "length"
            )
    return nominal or measured or None


def _recorded_ticks(
    recording: Recording,
    recorded: RecordedAction,
    rate: float | None,
    clocks: _Clocks,
    action_hz: float | None,
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    start, stop = _covered(recording, clocks)
    if action_hz is None or (rate and abs(action_hz - rate) <= RATE_TOLERANCE * rate):
        slack = _slack(clocks)
        kept = (recorded.time >= start - slack) & (recorded.time <= stop + slack)
        return _not_empty(recording, recorded.time[kept]), recorded.values[kept]
    if recorded.kind == "delta":
        known = f"{rate:g} Hz" if rate else "a rate that a single row does not tell"
        mend = f"data.action_hz to {rate:g} or null" if rate else "data.action_hz to null"
        raise RecordingError(
            f"{recording.path}: its actions are differences recorded at {known} and cannot be "
            f"held at data.action_hz={action_hz:g}. Set {mend}."
        )
    time = _not_empty(recording, _grid(recording, clocks, start, stop, action_hz))
    return time, recorded.values[last_at(recorded.time, time, _slack(clocks))]


def _pose_ticks(
    recording: Recording,
    poses: Stream,
    clocks: _Clocks,
    action_hz: float | None,
    action_rotation: ActionRotation,
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    if action_hz is None:
        raise ConfigError(
            f"data.action_hz is null, but the actions of {recording.path} are derived from poses "
            "and need a rate; set data.action_hz, for example to 10"
        )
    if len(np.unique(poses.time)) < 2:
        raise RecordingError(
            f"{recording.path}: its {len(poses.time)} pose(s) stand at one instant, so no action "
            "can be derived from them. Mend the recording's times or leave it out"
        )
    start, stop = _covered(recording, clocks)
    last = min(stop, float(poses.time[-1]) - 1 / action_hz)
    time = _not_empty(recording, _grid(recording, clocks, start, last, action_hz))
    edges = np.append(time, start + len(time) / action_hz)
    edges = np.minimum(edges, poses.time[-1])
    return time, _pose_actions(poses, edges, action_rotation)


def _pose_actions(
    poses: Stream, edges: NDArray[np.float64], action_rotation: ActionRotation
) -> NDArray[np.float32]:
    """Actions (edge - 1, 7) between poses interpolated at the edges."""
    clock, first = np.unique(poses.time, return_index=True)
    pose = poses.values[first].astype(np.float64)
    place = np.stack([np.interp(edges, clock, pose[:, axis]) for axis in range(3)], axis=1)
    if action_rotation == "rotvec":
        from scipy.spatial.transform import Rotation, Slerp  # slow to import, rarely needed

        # R = Rx(a)·Ry(b)·Rz(r), the arm's mobile XYZ convention.
        turned = Slerp(clock, Rotation.from_euler("XYZ", pose[:, 3:], degrees=True))(edges)
        # In the base frame: R(k+1)·R(k)ᵀ.
        rotation = (turned[1:] * turned[:-1].inv()).as_rotvec(degrees=True)
    else:
        # Keeps the recorder's own branch of the angles, made continuous; slerp might change it.
        angles = np.unwrap(pose[:, 3:], axis=0, period=360.0)
        at = np.stack([np.interp(edges, clock, angles[:, axis]) for axis in range(3)], axis=1)
        rotation = wrapped_deg(np.diff(at, axis=0))
    gripper = np.ones((len(edges) - 1, 1))
    return np.concatenate([np.diff(place, axis=0), rotation, gripper], axis=1).astype(np.float32)


def _covered(recording: Recording, clocks: _Clocks) -> tuple[float, float]:
    """The first and the last instant at which every stream has begun and none has ended."""
    late = max(clocks, key=lambda name: float(clocks[name][0]))
    early = min(clocks, key=lambda name: float(clocks[name][-1]))
    start, stop = float(clocks[late][0]), float(clocks[early][-1])
    if start > stop + _slack(clocks):
        raise RecordingError(
            f"{recording.path}: no instant is covered by every stream: {late} begins at "
            f"{start:.3f} s, after {early} has ended at {stop:.3f} s"
        )
    return start, stop


def _slack(clocks: _Clocks) -> float:
    """Most seconds that an entry may be after an instant and still count as at it."""
    return max(map(rounding, clocks.values()))


def _grid(
    recording: Recording, clocks: _Clocks, start: float, stop: float, rate_hz: float
) -> NDArray[np.float64]:
    """start, start + 1/rate, … up to `stop` plus a microsecond or the clocks' slack."""
    count = np.floor((stop - start) * rate_hz + max(1e-6, _slack(clocks)) * rate_hz) + 1
    fastest = max(map(_hz, clocks.values()))
    if count > _MOST_TICKS or 0 < fastest < _SLOWEST_HZ:
        raise RecordingError(
            f"{recording.path}: are the clocks in seconds? {stop - start:g} s would be "
            f"{count:,.0f} ticks at {rate_hz:g} Hz, and its fastest stream has {fastest:.2g} "
            "entries a second. Divide the recording's times by 1e3 or 1e9, or lower data.action_hz"
        )
    return start + np.arange(max(0.0, count)) / rate_hz


def _not_empty(recording: Recording, time: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(time):
        raise RecordingError(
            f"{recording.path}: too short: no tick has every stream and a following action"
        )
    return time


def _hz(clock: NDArray[np.float64]) -> float:
    """Entries per second; 0 for a clock without two different times."""
    steps = np.diff(clock)
    steps = steps[steps > 0]
    return 1.0 / float(np.median(steps)) if len(steps) else 0.0
