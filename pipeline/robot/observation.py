"""What a robot says, checked: a mapping from outside becomes an `Observation`, or is refused.

Each refusal names the field, what was expected, what was found, and what to mend.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pipeline.base.clock import CLOCK_SLACK_S
from pipeline.base.errors import ObservationError
from pipeline.robot.chunking import PlanGuide

LONGEST_PROMPT: Final = 1000
"""Characters of an instruction."""
LARGEST_SEED: Final = 2**63

STREAMS: Final = ("state", "sensor")


@dataclass(frozen=True)
class RobotObservation:
    """One observation of a robot, as it is known to be good."""

    readings: Mapping[str, NDArray[Any]]
    """What `RobotMemory.sense` takes: `time` (1,), and of each stream that came, its readings
    (reading, channel) in float32 and their times (reading,) in float64."""
    frames: Mapping[str, NDArray[np.uint8]]
    """RGB (height, width, 3) of each view that came, in the policy's order."""
    frame_time_s: NDArray[np.float64]
    """(view,) of all views of the policy; NaN of a missing one."""
    prompt: str | None
    reset: bool
    seed: int | None
    guide: PlanGuide | None

    @property
    def time_s(self) -> float:
        """The robot's clock when it was made."""
        return float(self.readings["time"][0])


class ObservationReader:
    """Reads the observations of one robot, which follow one another, for the policy of `metadata`.

    One that is refused leaves no trace.
    """

    def __init__(self, metadata: Mapping[str, Any]) -> None:
        self._views: Sequence[str] = metadata["streams"]["views"]
        self._channels = {
            name: len(metadata["streams"].get(name, {}).get("names", ())) for name in STREAMS
        }
        self._chunk = (metadata["horizon"], metadata["action_dim"])
        self._stochastic: bool = metadata["stochastic"]
        self._newest_s: dict[str, float] = {}

    def read(self, given: Any) -> RobotObservation:
        """The observation of these fields. Raises `ObservationError`."""
        if not isinstance(given, Mapping):
            raise ObservationError(f"expected fields by name, found {type(given).__name__}")
        self._refuse_unknown(given)
        reset, seed = _reset(given.get("reset", False))
        newest_s = {} if reset else dict(self._newest_s)
        time = self._time(given, newest_s)
        readings = {"time": time}
        for name in STREAMS:
            readings |= self._stream(name, given, float(time[0]), newest_s)
        frames = {view: _frame(f"images/{view}", given[f"images/{view}"]) for view in self._views
                  if f"images/{view}" in given}  # fmt: skip
        observation = RobotObservation(
            readings=readings,
            frames=frames,
            frame_time_s=self._frame_times(given, frames, float(time[0])),
            prompt=_prompt(given.get("prompt")),
            reset=reset,
            seed=seed,
            guide=self._guide(given),
        )
        self._newest_s = newest_s
        return observation

    def _refuse_unknown(self, given: Mapping[str, Any]) -> None:
        known = ["time", "prompt", "reset", "guide/chunk", "guide/weight"]
        known += [name for stream in STREAMS for name in (stream, f"{stream}_time")]
        known += [f"{of}/{view}" for view in self._views for of in ("images", "images_time")]
        for name in given:
            if name in known:
                continue
            near = get_close_matches(str(name), known, 1, 0.75)
            meant = f"did you mean {near[0]}?" if near else "Leave it out."
            raise ObservationError(
                f"{name!s:.80}: expected one of {', '.join(known)}, found a field of this "
                f"name. {meant}"
            )

    def _time(self, given: Mapping[str, Any], newest_s: dict[str, float]) -> NDArray[np.float64]:
        if "time" not in given:
            raise ObservationError("time: expected the robot's clock now, in s, found none")
        time = _numbers("time", given["time"], (1,), np.float64)
        now, before = float(time[0]), newest_s.get("time", -np.inf)
        if now < before:
            raise ObservationError(
                f"time: expected {before} s or later, as the last observation was made then, found "
                f"{now}. Send reset where a new episode begins"
            )
        newest_s["time"] = now
        return time

    def _stream(
        self, name: str, given: Mapping[str, Any], now_s: float, newest_s: dict[str, float]
    ) -> dict[str, NDArray[Any]]:
        """The readings of a stream and their times, checked; nothing where none came."""
        clock = f"{name}_time"
        if name not in given and clock not in given:
            return {}
        for there, missing in ((name, clock), (clock, name)):
            if missing not in given:
                raise ObservationError(f"{missing}: expected it beside {there}, found none")
        if not self._channels[name]:
            raise ObservationError(
                f"{name}: expected none, as the policy was trained without, found some. Leave it "
                "out"
            )
        values = _numbers(name, given[name], ("reading", self._channels[name]), np.float32)
        times = _numbers(clock, given[clock], (len(values),), np.float64)
        if len(times):
            before = newest_s.get(name, -np.inf)
            if times[0] < before or (np.diff(times) < 0).any():
                raise ObservationError(
                    f"{clock}: expected ascending times from {before} s on, where the last "
                    f"readings ended, found {times[0]} to {times[-1]}. Send each reading once, in "
                    "order"
                )
            _check_not_later(clock, float(times[-1]), now_s)
            newest_s[name] = float(times[-1])
        return {name: values, clock: times}

    def _frame_times(
        self, given: Mapping[str, Any], frames: Mapping[str, Any], now_s: float
    ) -> NDArray[np.float64]:
        times = np.full(len(self._views), np.nan)
        for place, view in enumerate(self._views):
            name = f"images_time/{view}"
            if view not in frames:
                if name in given:
                    raise ObservationError(f"images/{view}: expected it beside {name}, found none")
                continue
            times[place] = _numbers(name, given.get(name, now_s), (1,), np.float64)[0]
            _check_not_later(name, float(times[place]), now_s)
        return times

    def _guide(self, given: Mapping[str, Any]) -> PlanGuide | None:
        names = [name for name in ("guide/chunk", "guide/weight") if name in given]
        if not names:
            return None
        if len(names) == 1:
            raise ObservationError(f"{names[0]}: expected guide/chunk and guide/weight, found one")
        if not self._stochastic:
            raise ObservationError(
                "guide/chunk: expected none, as this policy draws nothing that could be guided, "
                "found one. Choose another chunking than rtc"
            )
        chunk = _numbers("guide/chunk", given["guide/chunk"], self._chunk, np.float32)
        weight = _numbers("guide/weight", given["guide/weight"], self._chunk[:1], np.float32)
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ObservationError("guide/weight: expected 0 to 1, found something beyond")
        return PlanGuide(chunk, weight)


def _numbers(
    name: str, value: Any, axes: Sequence[int | str], dtype: type[np.floating[Any]]
) -> NDArray[Any]:
    """The value as finite numbers of this dtype; an axis that has only a name is of any length.

    Where one number is expected, it may stand alone.
    """
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.empty(0, object)
    if array.dtype.kind not in "biuf":
        raise ObservationError(f"{name}: expected numbers, found {type(value).__name__}")
    if axes == (1,) and array.ndim == 0:
        array = array[None]
    fits = array.ndim == len(axes) and all(
        isinstance(size, str) or have == size for have, size in zip(array.shape, axes, strict=True)
    )
    if not fits:
        shape = ", ".join(map(str, axes))
        raise ObservationError(f"{name}: expected shape ({shape}), found {array.shape}")
    with np.errstate(over="ignore"):
        array = array.astype(dtype)
    if not (finite := np.isfinite(array)).all():
        place = np.argwhere(~finite)[0].tolist()
        raise ObservationError(f"{name}: expected finite numbers, found {array[*place]} at {place}")
    return array


def _frame(name: str, value: Any) -> NDArray[np.uint8]:
    if not isinstance(value, np.ndarray):
        raise ObservationError(f"{name}: expected an array, found {type(value).__name__}")
    height, width, channels = value.shape if value.ndim == 3 else (0, 0, 0)
    if value.dtype != np.uint8 or channels != 3 or not height or not width:
        raise ObservationError(
            f"{name}: expected RGB (height, width, 3) of uint8, found shape {value.shape} of "
            f"{value.dtype}"
        )
    return value


def _prompt(value: Any) -> str | None:
    if value is None or (isinstance(value, str) and len(value) <= LONGEST_PROMPT):
        return value
    found = f"{len(value)} characters" if isinstance(value, str) else type(value).__name__
    raise ObservationError(
        f"prompt: expected a text of at most {LONGEST_PROMPT} characters, found {found}"
    )


def _reset(value: Any) -> tuple[bool, int | None]:
    """Whether a new episode begins, and the seed of what is drawn in it."""
    if isinstance(value, bool | np.bool_):
        return bool(value), None
    if isinstance(value, int | np.integer) and 0 <= value < LARGEST_SEED:
        return True, int(value)
    raise ObservationError(f"reset: expected true, false or a seed from 0 on, found {value!r:.80}")


def _check_not_later(name: str, time_s: float, now_s: float) -> None:
    if time_s > now_s + CLOCK_SLACK_S:
        raise ObservationError(
            f"{name}: expected at most {now_s} s, the time of the observation, found {time_s}. "
            "Give all times on one clock"
        )
