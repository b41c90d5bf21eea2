"""A robot's observations, checked: a mapping from outside becomes a `RobotObservation`.

Each refusal names the field, what was expected, what was found, and what to mend. `KEY_MAPS`
translates the names that openpi's clients of known robots give to what they send.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pipeline.base.arrays import first_non_finite
from pipeline.base.errors import ConfigError, ObservationError
from pipeline.base.provenance import CLOCK_SLACK_S
from pipeline.robot.loop import PlanGuide

LONGEST_PROMPT: Final = 1000
"""Characters of an instruction."""
LARGEST_SEED: Final = 2**63

STREAMS: Final = ("state", "sensor")
_STILL: Final = 10
_STILL_S: Final = 2.0
_HINT: Final = ". For a client with openpi's names of a robot set serve.transform on the server"


@dataclass(frozen=True)
class RobotObservation:
    """One checked observation of a robot."""

    readings: Mapping[str, NDArray[Any]]
    """For `RobotMemory.sense`: `time` (1,), and for each stream received, its readings (reading,
    channel) in float32 and their times (reading,) in float64."""
    frames: Mapping[str, NDArray[np.uint8]]
    """RGB (height, width, 3) of each view received, in the policy's order."""
    frame_time_s: NDArray[np.float64]
    """(view,) for all views of the policy; NaN for a missing view."""
    prompt: str | None
    reset: bool
    seed: int | None
    guide: PlanGuide | None

    @property
    def time_s(self) -> float:
        """The time on the robot's clock."""
        return float(self.readings["time"][0])


@dataclass(frozen=True)
class KeyMap:
    """Names of the images, in the order of the policy's views, and of the parts of the state."""

    images: tuple[str, ...]
    state: tuple[str, ...]

    def refuse_more(self, views: Sequence[str]) -> None:
        """Raise `ConfigError` for a policy with more views than there are images."""
        if len(views) > len(self.images):
            raise ConfigError(
                f"serve.transform: expected a policy of at most {len(self.images)} views "
                f"({', '.join(self.images)}), found {', '.join(views)}"
            )

    def apply(self, given: Mapping[str, Any], views: Sequence[str]) -> dict[str, Any]:
        """The fields under the policy's names; what is not known keeps its name.

        An image whose name is that of a view stays that view; the others are the views in order,
        and those beyond the views are left out. An image may have its channels first. Raises
        `ObservationError` where a part of the state is missing, or is no number.
        """
        fields = {name: value for name, value in given.items() if name not in self.images}
        own = [f"images/{view}" for view in views]
        named = not {*own}.isdisjoint(self.images)
        places = {n: n for n in own} if named else dict(zip(self.images, own, strict=False))
        for name, place in places.items():
            if name in given:
                fields[place] = _channels_last(given[name])
        parts = [name for name in self.state if name in fields]
        if parts and len(parts) < len(self.state):
            missing = ", ".join(name for name in self.state if name not in parts)
            raise ObservationError(f"{missing}: expected it beside {parts[0]}, found none")
        if parts:
            try:
                joined = np.concatenate([np.atleast_1d(fields.pop(name)) for name in parts], -1)
            except ValueError as error:
                raise ObservationError(
                    f"{' + '.join(parts)}: expected numbers of one reading, found {error}"
                ) from None
            fields["state"] = joined
        return fields


KEY_MAPS: Mapping[str, KeyMap] = {
    "aloha": KeyMap(
        images=(
            "images/cam_high", "images/cam_left_wrist", "images/cam_right_wrist", "images/cam_low",
        ),
        state=("state",),
    ),
    "droid": KeyMap(
        images=("observation/exterior_image_1_left", "observation/wrist_image_left"),
        state=("observation/joint_position", "observation/gripper_position"),
    ),
    "libero": KeyMap(
        images=("observation/image", "observation/wrist_image"), state=("observation/state",)
    ),
}  # fmt: skip
"""By the names of `serve.transform`; as openpi's examples of these robots have them."""


def _channels_last(image: Any) -> Any:
    first = isinstance(image, np.ndarray) and image.ndim == 3 and image.shape[0] == 3
    return np.moveaxis(image, 0, -1) if first and image.shape[-1] != 3 else image


class ObservationReader:
    """Reads one robot's observations, in order, for the policy of `metadata`.

    A refused observation changes nothing.
    """

    def __init__(self, metadata: Mapping[str, Any], key_map: KeyMap | None = None) -> None:
        """`key_map` translates the names of a known robot's client."""
        streams = metadata["streams"]
        self._views: Sequence[str] = streams["views"]
        self._key_map = key_map
        self._chunk = (metadata["horizon"], metadata["action_dim"])
        widths = {name: len(streams.get(name, {}).get("names", ())) for name in STREAMS}
        self._widths = {name: width for name, width in widths.items() if width}
        self._clocks = {name: f"{name}_time" for name in self._widths}
        self._clocks |= {f"images/{view}": f"images_time/{view}" for view in self._views}
        self._known = ["time", "prompt", "reset", *self._clocks, *self._clocks.values()]
        if metadata["stochastic"]:
            self._known += ["guide/chunk", "guide/weight"]
        self._newest_s: Mapping[str, float] = {}

    def read(self, given: Any) -> RobotObservation:
        """The observation made of these fields. Raises `ObservationError`.

        `time` defaults to the newest time among the fields, else to this machine's clock. A frame
        or a single reading without a time gets `time`. Fields may be nested: `images` with views.
        """
        if not isinstance(given, Mapping):
            raise ObservationError(f"expected fields by name, found {type(given).__name__}")
        given = _flat(given)
        if self._key_map is not None:
            given = self._key_map.apply(given, self._views)
        if unknown := [str(name) for name in given if name not in self._known]:
            known = ", ".join(self._known)
            hint = "" if self._key_map or "observation/" not in unknown[0] else _HINT
            raise ObservationError(
                f"{unknown[0]:.80}: expected one of {known}, which this policy takes{hint}"
            )
        reset, seed = _reset(given.get("reset", False))
        values = self._values(given)
        times = self._times(given, values)
        newest_s = self._follow({} if reset else self._newest_s, times)
        readings = {"time": times["time"]}
        for name in self._widths:
            if len(values.get(name, ())):
                readings |= {name: values[name], f"{name}_time": times[name]}
        images = {view: f"images/{view}" for view in self._views}
        observation = RobotObservation(
            readings=readings,
            frames={view: values[name][0] for view, name in images.items() if name in values},
            frame_time_s=np.array([times.get(name, [np.nan])[0] for name in images.values()]),
            prompt=_prompt(given.get("prompt")),
            reset=reset,
            seed=seed,
            guide=self._guide(given),
        )
        self._newest_s = newest_s
        return observation

    def _values(self, given: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        """The readings (reading, channel) of each stream received; a frame is one reading."""
        values: dict[str, NDArray[Any]] = {}
        for name in self._clocks:
            if name in given and name in self._widths:
                shape = ("reading", self._widths[name])
                values[name] = _numbers(name, given[name], shape, np.float32)
            elif name in given:
                values[name] = _frame(name, given[name])[None]
        return values

    def _times(
        self, given: Mapping[str, Any], values: Mapping[str, NDArray[Any]]
    ) -> dict[str, NDArray[np.float64]]:
        """The times (reading,) in s of each of the values, and `time` (1,)."""
        times: dict[str, NDArray[np.float64]] = {}
        for name, clock in self._clocks.items():
            if clock in given and name not in given:
                raise ObservationError(f"{name}: expected it beside {clock}, found none")
            if clock in given:
                times[name] = _numbers(clock, given[clock], (len(values[name]),), np.float64)
        newest_s = max((own.max() for own in times.values() if len(own)), default=monotonic())
        now = _numbers("time", given.get("time", newest_s), (1,), np.float64)
        for name, own in values.items():
            if name not in times and len(own) != 1:
                clock = self._clocks[name]
                raise ObservationError(f"{clock}: expected it beside {name}, found none")
        return {"time": now} | dict.fromkeys(values, now) | times

    def _follow(
        self, before: Mapping[str, float], times: Mapping[str, NDArray[np.float64]]
    ) -> Mapping[str, float]:
        """The newest times by name; raises unless `times` are in order and follow `before`."""
        newest_s, now_s = dict(before), times["time"][0]
        for name, own in times.items():
            after = before.get(name, -np.inf)
            line = np.array([after, *own, now_s + CLOCK_SLACK_S])
            if (np.diff(line) < 0).any():
                ended = f" from {after} s, where the last ended," if name in before else ""
                raise ObservationError(
                    f"{self._clocks.get(name, name)}: expected times{ended} to "
                    f"{now_s} s, the observation's own, found {own[0]} to "
                    f"{own[-1]}. Send each reading once, in order and on one clock, and reset "
                    "where a new episode begins"
                )
            if len(own) and name in ("time", *STREAMS):
                newest_s[name] = float(own[-1])
        return newest_s

    def _guide(self, given: Mapping[str, Any]) -> PlanGuide | None:
        if not {"guide/chunk", "guide/weight"} & given.keys():
            return None
        chunk = _numbers("guide/chunk", given.get("guide/chunk"), self._chunk, np.float32)
        weight = _numbers("guide/weight", given.get("guide/weight"), self._chunk[:1], np.float32)
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ObservationError("guide/weight: expected 0 to 1, found something beyond")
        return PlanGuide(chunk, weight)


class Doubts:
    """What is hardly right in an episode of a robot; each doubt is raised once."""

    def __init__(self) -> None:
        self._raised, self._new = set[str](), list[str]()
        self._last = dict[str, tuple[NDArray[np.uint8], int, float]]()
        """Of each view the newest frame, how many in a row were equal to it, and since when."""

    def add(self, name: str, text: str) -> None:
        """Raise the doubt `name` in these words, unless it was raised before."""
        if name not in self._raised:
            self._raised.add(name)
            self._new.append(text)

    def take(self) -> list[str]:
        """The doubts that were raised since the last call, in words."""
        new, self._new = self._new, []
        return new

    def look(self, observation: RobotObservation) -> None:
        """Doubt a frame of one value, a state of zeros, and a picture that stands still.

        It stands still if it is the same to the bit in `_STILL` frames in a row over `_STILL_S`
        seconds: a camera that runs has noise.
        """
        now_s = observation.time_s
        for view, frame in observation.frames.items():
            name = f"images/{view}"
            if frame.min() == frame.max():
                text = f"{name}: every pixel is {frame.min()}: is the camera covered or off?"
                self.add(name, text)
            last, times, since_s = self._last.get(view, (None, 0, now_s))
            if last is None or not np.array_equal(last, frame):
                times, since_s = 0, now_s
            self._last[view] = frame, times + 1, since_s
            if times + 1 >= _STILL and now_s - since_s >= _STILL_S:
                still = (
                    f"{name}: the same picture for {now_s - since_s:.1f} s: does the camera run?"
                )
                self.add(f"{name} still", still)
        state = observation.readings.get("state")
        if state is not None and not state.any():
            self.add("state", "state: every channel is exactly 0: is it read from the robot?")


def _flat(given: Mapping[Any, Any]) -> dict[Any, Any]:
    """The fields with those of nested mappings: `{"images": {"a": x}}` as `{"images/a": x}`."""
    flat: dict[Any, Any] = {}
    for name, value in given.items():
        inner = value if isinstance(value, Mapping) and value else {None: value}
        for key, own in inner.items():
            place = name if key is None else f"{name}/{key}"
            if place in flat:
                raise ObservationError(f"{place:.80}: expected it once, found it twice")
            flat[place] = own
    return flat


def _numbers(
    name: str, value: Any, axes: Sequence[int | str], dtype: type[np.floating[Any]]
) -> NDArray[Any]:
    """The value as finite numbers of this dtype; an axis with only a name has any length.

    A single number, and a single reading, may come without the first axis.
    """
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.empty(0, object)
    if array.dtype.kind not in "biuf":
        raise ObservationError(f"{name}: expected numbers, found {type(value).__name__}")
    if array.shape == tuple(axes[1:]) and axes[0] in (1, "reading"):
        array = array[None]
    fits = array.ndim == len(axes) and all(
        isinstance(size, str) or have == size for have, size in zip(array.shape, axes, strict=True)
    )
    if not fits:
        shape = ", ".join(map(str, axes))
        raise ObservationError(f"{name}: expected shape ({shape}), found {array.shape}")
    with np.errstate(over="ignore"):
        array = array.astype(dtype)
    if (place := first_non_finite(array)) is not None:
        raise ObservationError(f"{name}: expected finite numbers, found {array[place]} at {place}")
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
    raise ObservationError(
        f"prompt: expected a text of at most {LONGEST_PROMPT} characters, found {value!r:.80}"
    )


def _reset(value: Any) -> tuple[bool, int | None]:
    """Whether a new episode begins, and the seed of its samples."""
    if isinstance(value, bool | np.bool_):
        return bool(value), None
    if isinstance(value, int | np.integer) and 0 <= value < LARGEST_SEED:
        return True, int(value)
    raise ObservationError(f"reset: expected true, false or a seed from 0 on, found {value!r:.80}")
