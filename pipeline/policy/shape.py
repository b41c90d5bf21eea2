"""The shape of a policy: the widths of its streams and the kinds of its channels. No torch."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from pipeline.base.documents import Text
from pipeline.base.errors import ConfigError

MOST = 1_000_000
"""The most channels of a stream, slots or widths of features."""
Size = Annotated[int, Field(ge=0, le=MOST)]
Group = Annotated[str, Field(pattern="^(translation|rotation|gripper|other)$")]
Share = Annotated[float, Field(ge=0, le=1)]
Axes = Mapping[str, int | None]
"""Names and sizes of a tensor's axes; None is any size above 0."""

Kind = Literal["plain", "deg", "rad", "rotation"]
"""A channel is plain, an angle, or one of the three angles (deg) of a pose's rotation."""

_POSE_ANGLES = ("pose_a", "pose_b", "pose_r")
_ANGLES: dict[str, Kind] = {"deg": "deg", "rad": "rad"}
_ROTVEC = ("rx", "ry", "rz")
_SIX = tuple(f"rotation_{index}" for index in range(6))


def channel_kinds(names: Sequence[str], units: Sequence[str]) -> tuple[Kind, ...]:
    """The kind of each channel; the three pose angles of the arm together are a rotation."""
    turned = {*_POSE_ANGLES} <= {*names}
    kinds: list[Kind] = []
    for name, unit in zip(names, units, strict=True):
        kind = _ANGLES.get(unit.lower(), "plain")
        kinds.append("rotation" if turned and name in _POSE_ANGLES and kind == "deg" else kind)
    return tuple(kinds)


def expanded_names(names: Sequence[str], kinds: Sequence[Kind]) -> list[str]:
    """The names of the channels that `expand` returns."""
    plain = [name for name, kind in zip(names, kinds, strict=True) if kind == "plain"]
    angles = [name for name, kind in zip(names, kinds, strict=True) if kind in ("deg", "rad")]
    waves = [f"{name}_{wave}" for wave in ("sin", "cos") for name in angles]
    return [*plain, *waves, *(_SIX if "rotation" in kinds else ())]


def typical_state(mean: Sequence[float], kinds: Sequence[Kind]) -> list[float]:
    """The state (channel,) whose expansion is nearest to the mean (expanded,).

    Rotations are 0: relative to itself, a reading has none.
    """
    if not {*kinds} - {"plain"}:
        return list(mean)
    plain, angles = kinds.count("plain"), kinds.count("deg") + kinds.count("rad")
    waves = mean[plain : plain + 2 * angles]
    known = iter(mean[:plain])
    turned = iter(zip(waves[:angles], waves[angles:], strict=True))
    state: list[float] = []
    for kind in kinds:
        angle = math.atan2(*next(turned)) if kind in ("deg", "rad") else 0.0
        written = math.degrees(angle) if kind == "deg" else angle
        state.append(next(known) if kind == "plain" else written)
    return state


@dataclass(frozen=True)
class Anchor:
    """Action channels that count from the state when the newest frame was taken.

    `state` are the channels of the state that measure their motion. A rotation vector is
    `composed` with the rotation of the three angles of the arm's pose; other channels are added.
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    action: tuple[Size, ...]
    state: tuple[Size, ...]
    composed: bool = False


@dataclass(frozen=True)
class SlotPlace:
    """What a slot is pooled over, without its layer: all layers of a store have the same places."""

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    pooling: Text
    view: Text | None = None
    center: tuple[Share, Share] | None = None
    """Row and column of its cell's centre, as shares of the view's height and width."""


def slot_places(documents: Sequence[Mapping[str, Any]]) -> tuple[SlotPlace, ...]:
    """The places of a spec's slots of one variant, in order; the layers repeat them."""
    first = (documents[0]["layer"], documents[0]["norm"]) if documents else None
    ours = [slot for slot in documents if (slot["layer"], slot["norm"]) == first]
    sides: dict[str, tuple[int, int]] = {}
    for slot in ours:
        if cell := slot.get("cell"):
            rows, columns = sides.get(slot["pooling"], (0, 0))
            sides[slot["pooling"]] = max(rows, cell[0] + 1), max(columns, cell[1] + 1)
    places = []
    for slot in ours:
        pooling, cell = slot["pooling"], slot.get("cell")
        rows, columns = sides.get(pooling, (1, 1))
        center = ((cell[0] + 0.5) / rows, (cell[1] + 0.5) / columns) if cell else None
        places.append(SlotPlace(pooling, slot.get("view"), center))
    return tuple(places)


def shared_statistics(places: Sequence[SlotPlace], layers: int) -> tuple[int, ...]:
    """For each slot the index of its statistics, which the tokens of a layer and view share.

    Other slots have their own: on a fixed camera, a cell's own mean takes out the background.
    """
    kinds = [
        (layer, place.view if place.pooling == "tokens" else index)
        for layer in range(layers)
        for index, place in enumerate(places)
    ]
    number = {kind: index for index, kind in enumerate(dict.fromkeys(kinds))}
    return tuple(number[kind] for kind in kinds)


def find_anchors(
    action: Mapping[str, Any], state: Mapping[str, Any], wanted: Sequence[str]
) -> tuple[Anchor, ...]:
    """The anchors of the `wanted` action channels; `action` and `state` are streams of a store.

    The delta `dx` is measured by `x` or `pose_x` in the same unit, `joint_1` by `joint_1`; the
    rotation vector `rx`, `ry`, `rz`, which is anchored as a whole, by the angles of the arm's pose.
    Raises `ConfigError` naming a channel that is no such delta.
    """
    measured = told_deltas(action, state)
    whole = {*_ROTVEC} <= {*wanted} & {*action["names"]} and {*_POSE_ANGLES} <= {*state["names"]}
    composed = _ROTVEC if whole and action["kind"] == "delta" else ()
    if unknown := [name for name in wanted if name not in {*measured, *composed}]:
        raise ConfigError(
            "train_head.anchor: expected deltas whose motion the state tells "
            f"({', '.join(measured) or 'the training episodes have none'}), "
            f"found {', '.join(unknown)}"
        )
    anchors = [Anchor((action["names"].index(n),), (measured[n],)) for n in wanted if n in measured]
    if composed:
        places = [(action, _ROTVEC), (state, _POSE_ANGLES)]
        anchors.append(Anchor(*(tuple(map(s["names"].index, n)) for s, n in places), composed=True))
    return tuple(anchors)


def find_relative(action: Mapping[str, Any], state: Mapping[str, Any]) -> tuple[Anchor, ...]:
    """Which channels of the state measure these absolute actions.

    Angles of the arm's pose are left out: a rotation is no difference of angles. Raises
    `ConfigError` where actions are not absolute, or the state measures none of them.
    """
    kinds = channel_kinds(state["names"], state["units"])
    absolute = action["kind"] == "absolute"
    channels = zip(action["names"], action["units"], strict=True) if absolute else ()
    by_state = [_told(name, unit, state) for name, unit in channels]
    pairs = [
        Anchor((place,), (measured,))
        for place, measured in enumerate(by_state)
        if measured is not None and kinds[measured] != "rotation"
    ]
    if not pairs:
        raise ConfigError(
            "train_head.action_form: relative needs absolute actions that the state measures, of "
            f"the same name and unit; the actions are {action['kind']}: "
            f"{', '.join(action['names'])}; the state has {', '.join(state['names']) or 'nothing'}"
        )
    return tuple(pairs)


def told_deltas(action: Mapping[str, Any], state: Mapping[str, Any]) -> dict[str, int]:
    """The delta channels that can be anchored one by one, each with its channel of the state."""
    deltas = zip(action["names"], action["units"], strict=True) if action["kind"] == "delta" else ()
    return {name: place for name, unit in deltas if (place := _told(name, unit, state)) is not None}


def _told(name: str, unit: str, state: Mapping[str, Any]) -> int | None:
    """The state's channel whose change a delta is."""
    bare = name.removeprefix("delta_").removeprefix("d")
    channels = list(zip(state["names"], state["units"], strict=True))
    known = [(n, unit) for n in (name, bare, f"pose_{bare}") if (n, unit) in channels]
    return channels.index(known[0]) if known else None


@dataclass(frozen=True)
class PolicyShape:
    """The widths of a policy's streams; 0 where the store lacks the stream.

    The bounds hold where a checkpoint's document is read.
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    slots: Size
    feature_dim: Size
    sensor_channels: Size
    state_dim: Size
    action_dim: Annotated[int, Field(ge=1, le=MOST)]
    action_groups: tuple[Group, ...]
    """The group of each action channel."""
    views: Size = 0
    """Views whose ages are inputs."""
    state_kinds: tuple[Kind, ...] = ()
    """The kind of each state channel; empty where all are plain."""
    anchors: tuple[Anchor, ...] = ()
    """Action channels that count from the newest frame; the others from the tick."""
    relative: tuple[Anchor, ...] = ()
    """Absolute action channels that are learned as differences from the state at the tick."""
    places: tuple[SlotPlace, ...] = ()
    """The places of the slots of each layer; empty where they are not known."""
    history: Annotated[int, Field(ge=1, le=64)] = 1
    """VL rows that a sample sees, each with all slots, the newest first."""

    @property
    def layers(self) -> int:
        """How many layers the slots are of, with and without norm; each has all `places`."""
        return self.slots // len(self.places) if self.places else 1

    @property
    def statistics_of(self) -> tuple[int, ...]:
        """For each slot the index of its statistics."""
        return shared_statistics(self.places, self.layers) if self.places else (*range(self.slots),)

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kind of each state channel."""
        plain: tuple[Kind, ...] = ("plain",)
        return self.state_kinds or plain * self.state_dim

    @property
    def channels(self) -> dict[str, tuple[int, ...]]:
        """The shape of each stream's statistics and of the action's; states are expanded.

        With `relative` there are also those of the chunks that the policy learns.
        """
        expanded = expanded_names([""] * self.state_dim, self.kinds)
        learned = {"relative": (self.action_dim,)} if self.relative else {}
        return {
            "features": (len({*self.statistics_of}), self.feature_dim),
            "sensor": (self.sensor_channels,),
            "state": (len(expanded),),
            "action": (self.action_dim,),
            **learned,
        }

    def anchored(self, names: Sequence[str]) -> list[str]:
        """The names of the action channels that count from the newest frame."""
        return [names[channel] for anchor in self.anchors for channel in anchor.action]

    def relative_to_state(self, names: Sequence[str]) -> list[str]:
        """The names of the action channels that are learned as differences from the state."""
        return [names[channel] for anchor in self.relative for channel in anchor.action]

    def stream_axes(self) -> dict[str, Axes]:
        """The axes behind the batch of each field of an `Observation` of this shape."""
        return {
            "features": {"slot": self.slots * self.history, "dim": self.feature_dim},
            "slot_valid": {"slot": self.slots * self.history},
            "feature_age": {},
            "view_age": {"view": self.views},
            # Windows of any length: readings are placed by their ages.
            "sensor": {"window": None, "channel": self.sensor_channels},
            "sensor_valid": {},
            "sensor_age": {"window": None},
            "state": {"window": None, "channel": self.state_dim},
            "state_valid": {},
            "state_age": {"window": None},
        }
