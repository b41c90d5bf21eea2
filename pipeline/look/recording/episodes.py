"""A recording -> all of it that can be read, and a flaw for each part that cannot.

Each stream is read apart and once; ticks are then laid over what was read.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from pipeline.base.config import DataParams
from pipeline.base.errors import RecordingError
from pipeline.data import CameraStream, RecordedAction, Recording, Stream
from pipeline.data.timeline import ActionRotation, Timeline, build_timeline
from pipeline.look.recording.facts import EpisodeView, Flaw

Part = TypeVar("Part")

BROKEN = (RecordingError, OSError)
"""What a damaged recording raises: a reader's word, or a disk's."""


def view_episode(recording: Recording, data: DataParams, rotation: ActionRotation) -> EpisodeView:
    """Whatever of this recording can be read, and its ticks under `data`; no frame is decoded.

    A part that cannot be read is None (no cameras: empty) and becomes a flaw `unreadable`, streams
    that leave no tick a flaw `no ticks`; both are errors. Raises nothing for a broken recording,
    and `ConfigError` where poses need `data.action_hz`.
    """
    flaws: list[Flaw] = []

    def attempt(stream: str, read: Callable[[], Part]) -> Part | None:
        try:
            return read()
        except BROKEN as error:
            flaws.append(_flaw(recording, "unreadable", stream, error))
            return None

    view = EpisodeView(
        recording=recording,
        timeline=None,
        cameras=attempt("cameras", recording.cameras) or {},
        sensor=attempt("sensor", recording.sensor),
        state=attempt("state", recording.state),
        poses=None,
        action=attempt("action", recording.action),
        flaws=(),
        zero=0.0,
        instruction=attempt("instruction", lambda: recording.instruction),
        action_rotation=rotation,
    )
    # Poses are most often columns of the state, whose flaw has said what is wrong.
    if not any(flaw.stream == "state" for flaw in flaws):
        view = replace(view, poses=attempt("poses", recording.poses))
    zero = min((float(time[0]) for time in view.clocks.values()), default=0.0)
    broken = {flaw.stream for flaw in flaws}
    timeline = None
    if view.action is not None or view.poses is not None or not broken & {"action", "state"}:
        try:
            timeline = _timeline(view, data)
        except RecordingError as error:
            flaws.append(_flaw(recording, "no ticks", "ticks", error))
    return replace(view, timeline=timeline, flaws=_told_once(flaws), zero=zero)


class _Read(Recording):
    """What was read of a recording, so that ticks need not read it again."""

    def __init__(self, view: EpisodeView) -> None:
        one = view.recording
        self.id, self.source, self.format, self.path = one.id, one.source, one.format, one.path
        self.instruction = view.instruction or ""
        self._view = view

    def files(self) -> list[Path]:
        return self._view.recording.files()

    def cameras(self) -> Mapping[str, CameraStream]:
        return self._view.cameras

    def poses(self) -> Stream | None:
        return self._view.poses

    def action(self) -> RecordedAction | None:
        return self._view.action


def _timeline(view: EpisodeView, data: DataParams) -> Timeline:
    return build_timeline(
        _Read(view),
        data.action_hz,
        data.vlm_reuse_count,
        view.action_rotation,
        view.state,
        view.sensor,
    )


def _told_once(flaws: list[Flaw]) -> tuple[Flaw, ...]:
    """One broken file breaks every stream that is in it: its message stands once."""
    by_message: dict[str, Flaw] = {}
    for flaw in flaws:
        before = by_message.get(flaw.message)
        streams = flaw.stream if before is None else f"{before.stream}, {flaw.stream}"
        by_message[flaw.message] = replace(flaw, stream=streams)
    return tuple(by_message.values())


def _flaw(recording: Recording, kind: str, stream: str, error: Exception) -> Flaw:
    return Flaw(kind, "error", recording.source, recording.id, stream, None, None, str(error))
