"""An episode: a recording's streams and ticks, read once, and its channels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.base.border import named
from pipeline.base.errors import StoreMismatch
from pipeline.data.recording import Channels, Recording, Stream
from pipeline.data.timeline import ActionRotation, Timeline, build_timeline

_NO_CHANNELS = Channels((), ())


@dataclass(frozen=True)
class Embodiment:
    """Channels of action, sensor and state; no channels where a stream is absent."""

    action: Channels
    action_kind: str
    sensor: Channels = _NO_CHANNELS
    state: Channels = _NO_CHANNELS

    @classmethod
    def of(
        cls, action: Channels, action_kind: str, sensor: Stream | None, state: Stream | None
    ) -> "Embodiment":
        """The embodiment of a recording with these streams."""
        streams = {"sensor": sensor, "state": state}
        channels = {name: stream.channels for name, stream in streams.items() if stream is not None}
        return cls(action, action_kind, **channels)

    def document(self) -> dict[str, dict[str, Any]]:
        """Names and units of each stream and the kind of action, as a store keeps them."""
        document: dict[str, dict[str, Any]] = {}
        for stream in ("action", "sensor", "state"):
            channels: Channels = getattr(self, stream)
            document[stream] = {"names": list(channels.names), "units": list(channels.units)}
        document["action"]["kind"] = self.action_kind
        return document


@dataclass(frozen=True)
class ReadEpisode:
    """A recording, its ticks and its complete streams; a stream is None where it has none."""

    recording: Recording
    timeline: Timeline
    sensor: Stream | None
    state: Stream | None

    @property
    def embodiment(self) -> Embodiment:
        """Names and units of its channels."""
        line = self.timeline
        return Embodiment.of(line.action_channels, line.action_kind, self.sensor, self.state)

    @property
    def readings(self) -> int:
        """Readings of the sensor."""
        return len(self.sensor.time) if self.sensor else 0

    @property
    def states(self) -> int:
        """Readings of the robot state."""
        return len(self.state.time) if self.state else 0


def read_episode(
    recording: Recording,
    action_hz: float | None,
    vlm_reuse_count: int,
    action_rotation: ActionRotation,
) -> ReadEpisode:
    """Every stream of a recording and the ticks over it; no frame is decoded.

    Raises `RecordingError` where the recording cannot be read or has no tick, and `ConfigError`
    where actions are derived from poses and `action_hz` is None.
    """
    state, sensor = recording.state(), recording.sensor()
    line = build_timeline(recording, action_hz, vlm_reuse_count, action_rotation, state, sensor)
    return ReadEpisode(recording, line, sensor, state)


def common_embodiment(
    recordings: Sequence[tuple[Recording, Embodiment]], of: str, remedy: str
) -> Embodiment:
    """The embodiment that all these recordings share; a recording may lack a stream.

    Raises `StoreMismatch`, which names two recordings that differ in channels, units or kind of
    action, and ends with the `remedy`; `of` is the word for what they share, such as a store.
    """
    common: dict[str, Channels] = {}
    for stream in ("action", "state", "sensor"):
        having = [(recording, _kinds(own, stream)) for recording, own in recordings]
        having = [(recording, kinds) for recording, kinds in having if kinds[0].names]
        for recording, kinds in having[1:]:
            first, expected = having[0]
            if kinds != expected:
                raise StoreMismatch(
                    f"one {of} holds one embodiment, but the {stream} of source {first.source!r} "
                    f"({first.path}) is {_shown(*expected)} and that of source "
                    f"{recording.source!r} ({recording.path}) is {_shown(*kinds)}. {remedy}"
                )
        common[stream] = having[0][1][0] if having else _NO_CHANNELS
    return Embodiment(action_kind=recordings[0][1].action_kind, **common)


def _kinds(embodiment: Embodiment, stream: str) -> tuple[Channels, str]:
    return getattr(embodiment, stream), embodiment.action_kind if stream == "action" else ""


def _shown(channels: Channels, kind: str) -> str:
    pairs = zip(channels.names, channels.units, strict=True)
    names = [named(f"{name} ({unit})" if unit else name) for name, unit in pairs]
    listed = ", ".join(names if len(names) <= 12 else [*names[:4], "…", names[-1]])
    return f"{len(names)} {kind} channels [{listed}]".replace("  ", " ")
