"""Which episodes there are and what they are, without reading a sensor or decoding a frame.

The survey's plan digest names everything that decides what a store holds. Where a finished store
carries the same, there is nothing to do.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from pipeline.base.config import DataParams, Params
from pipeline.base.digests import ContentDigests, joint_digest
from pipeline.base.errors import RecordingError
from pipeline.data import BadEpisode, Recording, content_digest, open_recordings
from pipeline.data.timeline import ActionRotation, choose_action_rotation
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec


@dataclass(frozen=True)
class SurveyedEpisode:
    """A recording and what its files hold."""

    recording: Recording
    content: str
    """Digest of its files: equal content means equal streams."""
    digest: str
    """Digest of content and of everything else that decides what the store says of it."""


@dataclass(frozen=True)
class Survey:
    """What is to be in the store."""

    episodes: tuple[SurveyedEpisode, ...]
    missing: tuple[str, ...]
    """Listed by a data set's metadata, absent from its files."""
    bad: tuple[BadEpisode, ...]
    spec: FeatureSpec
    action_rotation: ActionRotation
    plan: str
    """Digest of all that decides what the store holds."""


def survey(params: Params, digests: ContentDigests) -> Survey:
    """Open every source, take the content digest of its files and name the feature spec.

    With `data.on_bad_episode: skip`, episodes that an earlier check found bad are left out. Raises
    `RecordingError` when no episode is usable, and whatever a source as a whole is refused for.
    """
    data = params.data
    opened = open_recordings(data.sources, data.root, data.views)
    rotation = choose_action_rotation(data.action_rotation, opened.recordings)
    episodes: list[SurveyedEpisode] = []
    bad = list(opened.bad)
    views: set[str] = set()
    for recording in tqdm(opened.recordings, "survey", unit="episode", disable=None, leave=False):
        try:
            content = content_digest(recording, digests.of)
            digest = _digest(recording, content, data, rotation)
            if data.on_bad_episode == "skip" and (reason := digests.bad(digest)) is not None:
                raise RecordingError(reason)
            views |= set(recording.view_names())
        except RecordingError as error:
            bad.append(BadEpisode(recording.source, recording.path, str(error)))
            continue
        episodes.append(SurveyedEpisode(recording, content, digest))
    if not episodes:
        refuse_bad(bad, of=len(bad))
    spec = feature_spec(params.vlm, params.extract.dtype, sorted(views), digests.of, digests.text)
    plan = joint_digest(
        spec.digest,
        params.extract.sensor_dtype,
        repr([(source.name, source.action_kind) for source in data.sources]),
        *(episode.digest for episode in episodes),
    )
    return Survey(tuple(episodes), opened.missing, tuple(bad), spec, rotation, plan)


def refuse_bad(bad: Sequence[BadEpisode], of: int) -> None:
    """Raise one `RecordingError` that lists every bad episode."""
    lines = [f"{len(bad)} of {of} episodes cannot be used:"]
    lines += [f"  {one.source}: {_reason(one)}" for one in bad]
    lines.append("Mend or remove them, or leave them out with --set data.on_bad_episode=skip.")
    raise RecordingError("\n".join(lines))


def _reason(bad: BadEpisode) -> str:
    where = str(bad.where)
    return bad.reason if where in bad.reason else f"{where}: {bad.reason}"


def shown_path(path: Path, root: Path) -> str:
    """A path relative to the data root where it lies below, so that a store can move."""
    try:
        return Path(os.path.abspath(path)).relative_to(os.path.abspath(root)).as_posix()
    except ValueError:
        return os.path.abspath(path)


def _digest(recording: Recording, content: str, data: DataParams, rotation: ActionRotation) -> str:
    return joint_digest(
        content,
        recording.source,
        recording.id,
        recording.format,
        recording.instruction,
        shown_path(recording.path, data.root),
        repr((data.action_hz, data.vlm_reuse_count, rotation)),
    )
