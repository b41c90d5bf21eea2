"""A recording -> its streams and the ticks over them, read once."""

from dataclasses import dataclass

from pipeline.data.embodiment import Embodiment
from pipeline.data.recording import Recording, Stream
from pipeline.data.timeline import ActionRotation, Timeline, build_timeline


@dataclass(frozen=True)
class ReadEpisode:
    """A recording, its ticks and its whole streams; None where it has no such stream."""

    recording: Recording
    timeline: Timeline
    sensor: Stream | None
    state: Stream | None

    @property
    def embodiment(self) -> Embodiment:
        """What its channels are."""
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

    Raises `RecordingError` for what cannot be read or has no tick, and `ConfigError` where actions
    are derived from poses and `action_hz` is None.
    """
    state, sensor = recording.state(), recording.sensor()
    line = build_timeline(recording, action_hz, vlm_reuse_count, action_rotation, state, sensor)
    return ReadEpisode(recording, line, sensor, state)
