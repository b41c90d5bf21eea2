"""Read every episode whole, before the first byte is written.

So all that is wrong is said at once, and before anything expensive runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from pipeline.config import Params
from pipeline.errors import RecordingError, StoreMismatch, VLMError
from pipeline.extraction.survey import Survey, SurveyedEpisode, refuse_bad
from pipeline.recordings import BadEpisode, Channels
from pipeline.timeline import Timeline, build_timeline
from pipeline.vlm.preparation import Preparer

NO_CHANNELS = Channels((), ())


@dataclass(frozen=True)
class CheckedEpisode:
    """An episode that was read whole and found sound; its streams are let go again."""

    surveyed: SurveyedEpisode
    timeline: Timeline
    sensor: Channels
    readings: int
    state: Channels
    states: int


def check_episodes(
    survey: Survey, params: Params
) -> tuple[list[CheckedEpisode], list[tuple[SurveyedEpisode, str]]]:
    """Read and check every episode; returns the sound ones, and the others with the reason.

    Raises one `RecordingError` that lists all that cannot be used, unless
    `data.on_bad_episode: skip` allows to leave them out, and `StoreMismatch` when two sources are
    not of one embodiment.
    """
    preparer = Preparer(params.vlm, survey.spec)
    good: list[CheckedEpisode] = []
    found: list[tuple[SurveyedEpisode, str]] = []
    for surveyed in tqdm(survey.episodes, "check", unit="episode", disable=None, leave=False):
        try:
            good.append(_checked(surveyed, survey, params, preparer))
        except RecordingError as error:
            found.append((surveyed, str(error)))
    recordings = [(surveyed.recording, reason) for surveyed, reason in found]
    bad = [*survey.bad, *(BadEpisode(one.source, one.path, reason) for one, reason in recordings)]
    if bad and (params.data.on_bad_episode == "stop" or not good):
        refuse_bad(bad, of=len(good) + len(bad))
    _check_one_embodiment(good)
    return good, found


def _checked(
    surveyed: SurveyedEpisode, survey: Survey, params: Params, preparer: Preparer
) -> CheckedEpisode:
    recording = surveyed.recording
    state, sensor = recording.state(), recording.sensor()
    timeline = build_timeline(
        recording,
        params.data.action_hz,
        params.data.vlm_reuse_count,
        survey.action_rotation,
        state,
        sensor,
    )
    cameras = recording.cameras()
    try:
        preparer.render(recording.instruction, list(cameras))
    except VLMError as error:
        raise RecordingError(f"{recording.path}: {error}") from None
    for view, camera in cameras.items():
        camera.check(np.unique(timeline.frames[view]).tolist())
    return CheckedEpisode(
        surveyed,
        timeline,
        sensor.channels if sensor else NO_CHANNELS,
        len(sensor.time) if sensor else 0,
        state.channels if state else NO_CHANNELS,
        len(state.time) if state else 0,
    )


def _check_one_embodiment(checked: Sequence[CheckedEpisode]) -> None:
    streams: dict[str, Callable[[CheckedEpisode], tuple[Channels, str]]] = {
        "action": lambda one: (one.timeline.action_channels, one.timeline.action_kind),
        "state": lambda one: (one.state, ""),
        "sensor": lambda one: (one.sensor, ""),
    }
    for stream, channels_of in streams.items():
        having = [one for one in checked if channels_of(one)[0].names]
        for one in having[1:]:
            if channels_of(one) != channels_of(having[0]):
                a, b = having[0].surveyed.recording, one.surveyed.recording
                raise StoreMismatch(
                    f"one store holds one embodiment, but the {stream} of source {a.source!r} "
                    f"({a.path}) is {_shown(*channels_of(having[0]))} and that of source "
                    f"{b.source!r} ({b.path}) is {_shown(*channels_of(one))}. Extract them into "
                    "two stores: one params file each, with its own data.sources and extract.store."
                )


def _shown(channels: Channels, kind: str) -> str:
    pairs = zip(channels.names, channels.units, strict=True)
    named = [f"{name} ({unit})" if unit else name for name, unit in pairs]
    listed = ", ".join(named if len(named) <= 12 else [*named[:4], "…", named[-1]])
    return f"{len(named)} {kind} channels [{listed}]".replace("  ", " ")
