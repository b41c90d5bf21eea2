"""Read every episode whole, before the first byte is written.

So all that is wrong is said at once, and before anything expensive runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.errors import RecordingError, VLMError
from pipeline.data import BadEpisode
from pipeline.data.embodiment import Embodiment, common_embodiment
from pipeline.data.timeline import Timeline, build_timeline
from pipeline.extract.survey import Survey, SurveyedEpisode, refuse_bad
from pipeline.vlm.preparation import Preparer


@dataclass(frozen=True)
class CheckedEpisode:
    """An episode that was read whole and found sound; its streams are let go again."""

    surveyed: SurveyedEpisode
    timeline: Timeline
    embodiment: Embodiment
    readings: int
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
    embodiment_of(good)
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
        Embodiment.of(timeline.action_channels, timeline.action_kind, sensor, state),
        len(sensor.time) if sensor else 0,
        len(state.time) if state else 0,
    )


def embodiment_of(checked: Sequence[CheckedEpisode]) -> Embodiment:
    """What all these episodes have in common; `StoreMismatch` where two sources differ."""
    return common_embodiment(
        [(one.surveyed.recording, one.embodiment) for one in checked],
        "store",
        "Extract them into two stores: one params file each, with its own data.sources and "
        "extract.store.",
    )
