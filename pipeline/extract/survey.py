"""Which episodes there are, what they hold, and whether each can be used.

A survey reads no sensor and decodes no frame. Its plan digest covers everything that decides what a
store holds: if a finished store has the same digest, there is nothing to do. `sound_episodes` reads
every episode completely before the first byte is written, so that all faults are listed at once,
before anything expensive runs.
"""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.base.config import PCA, DataParams, ExtractParams, Params, VLMParams
from pipeline.base.digests import ContentDigests, joint_digest
from pipeline.base.documents import Border
from pipeline.base.errors import RecordingError, StoreMismatch, VLMError
from pipeline.base.projection import Basis
from pipeline.base.provenance import RATE_TOLERANCE, Streams
from pipeline.base.text import capped
from pipeline.data import BadEpisode, Recording, content_digest, open_recordings
from pipeline.data.episode import Embodiment, common_embodiment, read_episode
from pipeline.data.recording import absolute
from pipeline.data.timeline import ActionRotation, choose_action_rotation
from pipeline.store.basis import basis_of, known_basis
from pipeline.store.documents import EpisodeText
from pipeline.store.episodes import EpisodeRows
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.preparation import Preparer

_STORED = Border(
    RecordingError,
    "No store could be read with it: rename or shorten it there, or leave the episode out.",
)
"""Refuses an episode whose texts a store's readers would refuse."""

_DECIDES_SPEED = ("weights", "adapter", "processor", "compute_dtype", "variants")

MOST_EPISODES = 10
"""How many unusable episodes a message lists; it only counts the rest."""


@dataclass(frozen=True)
class SurveyedEpisode:
    """A recording, and the texts that the store keeps about it, including its digests."""

    recording: Recording
    text: Mapping[str, str]
    views: tuple[str, ...]

    @property
    def content(self) -> str:
        """Digest of its files: equal content means equal streams."""
        return self.text["content"]

    @property
    def digest(self) -> str:
        """Digest of the content and of everything else that decides its rows in the store."""
        return self.text["digest"]


@dataclass(frozen=True)
class Survey:
    """What the store will hold.

    `missing` names episodes that a data set's metadata list but its files lack. `plan` is the
    digest of everything that decides what the store holds.
    """

    data: DataParams
    vlm: VLMParams
    extract: ExtractParams
    episodes: tuple[SurveyedEpisode, ...]
    missing: tuple[str, ...]
    bad: tuple[BadEpisode, ...]
    spec: FeatureSpec
    action_rotation: ActionRotation
    plan: str

    def on(self, basis: Basis) -> "Survey":
        """The survey of the same store with its features projected on this basis."""
        spec = self.spec.on(basis)
        return replace(self, spec=spec, plan=_plan(spec, self.data, self.extract, self.episodes))

    @property
    def target(self) -> Path:
        """The store."""
        return self.extract.store

    @property
    def recordings(self) -> list[Recording]:
        """The recordings of the episodes, in order."""
        return [episode.recording for episode in self.episodes]

    @property
    def contents(self) -> set[str]:
        """The content digests of the episodes."""
        return {episode.content for episode in self.episodes}

    @property
    def rate_name(self) -> str:
        """The name under which the speed of this model on these devices is stored.

        It leaves out what costs little time, such as the prompt, slots and names of views.
        """
        spec, workers = self.spec.attrs(), self.extract.workers
        by = f" on {workers}" if workers != 0 else ""
        deciding = {name: spec.get(name) for name in _DECIDES_SPEED} | {"views": len(spec["views"])}
        return f"{joint_digest(json.dumps(deciding, sort_keys=True))} {self.extract.device}{by}"


@dataclass(frozen=True)
class CheckedEpisode(EpisodeRows):
    """An episode that was read completely and is sound; its streams are not kept in memory."""

    recording: Recording
    embodiment: Embodiment


def survey(params: Params, digests: ContentDigests) -> Survey:
    """Open every source, take the content digest of its files and make the feature spec.

    With `data.on_bad_episode: skip`, episodes that an earlier check found bad are left out. Raises
    `RecordingError` when no episode is usable, and the error of a source that is refused as a
    whole.
    """
    data, vlm, extract = params.data, params.vlm, params.extract
    opened = open_recordings(data.sources, data.root, data.views)
    rotation = choose_action_rotation(data.action_rotation, opened.recordings)
    episodes, bad = list[SurveyedEpisode](), list(opened.bad)
    for recording in tqdm(opened.recordings, "survey", unit="episode", disable=None, leave=False):
        try:
            episode = _surveyed(recording, data, rotation, digests)
            if data.on_bad_episode == "skip" and (reason := digests.bad(episode.digest)):
                raise RecordingError(reason)
            episodes.append(episode)
        except RecordingError as error:
            bad.append(BadEpisode(recording.source, recording.path, str(error)))
    if not episodes:
        _refuse_bad(bad, total=len(bad))
    spec, plan = _spec_and_plan(data, vlm, extract, episodes, digests)
    return Survey(
        data, vlm, extract, tuple(episodes), opened.missing, tuple(bad), spec, rotation, plan
    )


def _spec_and_plan(
    data: DataParams,
    vlm: VLMParams,
    extract: ExtractParams,
    episodes: Sequence[SurveyedEpisode],
    digests: ContentDigests,
) -> tuple[FeatureSpec, str]:
    """The feature spec and the plan digest of a store of these episodes."""
    views = sorted({view for episode in episodes for view in episode.views})
    spec = feature_spec(vlm, extract.dtype, views, digests.of, digests.text)
    if spec.unfitted and (known := _known_basis(spec, extract)):
        spec = spec.on(known)
    return spec, _plan(spec, data, extract, episodes)


def _known_basis(spec: FeatureSpec, extract: ExtractParams) -> Basis | None:
    """The basis of the store that the params name, else of what lies at the target."""
    if not isinstance(extract.dtype, PCA) or extract.dtype.basis is None:
        return known_basis(extract.store, spec.document)
    assert spec.whole is not None
    return basis_of(extract.dtype.basis, (len(spec.groups), spec.whole.dim + 1, spec.dim))


def _plan(
    spec: FeatureSpec,
    data: DataParams,
    extract: ExtractParams,
    episodes: Sequence[SurveyedEpisode],
) -> str:
    return joint_digest(
        spec.digest,
        extract.sensor_dtype,
        *(["rate"] if data.action_hz is None else []),  # earlier stores did not keep it
        repr([(source.name, source.action_kind) for source in data.sources]),
        *(episode.digest for episode in episodes),
    )


def sound_episodes(
    surveyed: Survey, digests: ContentDigests
) -> tuple[Survey, list[CheckedEpisode]]:
    """Read and check every episode; returns the survey of the sound ones, and these.

    Raises one `RecordingError` that lists all unusable episodes, unless `data.on_bad_episode: skip`
    leaves them out, and `StoreMismatch` when two sources have different embodiments, or when
    `data.action_hz` is null and the episodes do not share one known rate.
    """
    data, preparer = surveyed.data, Preparer(surveyed.vlm, surveyed.spec)
    sound: list[SurveyedEpisode] = []
    checked: list[CheckedEpisode] = []
    failed: dict[str, BadEpisode] = {}
    for episode in tqdm(surveyed.episodes, "check", unit="episode", disable=None, leave=False):
        try:
            checked.append(_checked(episode, data, surveyed.action_rotation, preparer))
            sound.append(episode)
        except RecordingError as error:
            recording = episode.recording
            failed[episode.digest] = BadEpisode(recording.source, recording.path, str(error))
    bad = (*surveyed.bad, *failed.values())
    if bad and (data.on_bad_episode == "stop" or not sound):
        _refuse_bad(bad, total=len(sound) + len(bad))
    embodiment_of(checked)
    if data.action_hz is None:
        _refuse_rates(checked)
    if not failed:
        return surveyed, checked
    for digest, episode in failed.items():
        digests.note_bad(digest, episode.reason)
    spec, plan = _spec_and_plan(data, surveyed.vlm, surveyed.extract, sound, digests)
    reduced = replace(surveyed, episodes=tuple(sound), bad=bad, spec=spec, plan=plan)
    return reduced, checked


def embodiment_of(checked: Sequence[CheckedEpisode]) -> Embodiment:
    """The embodiment that all these episodes share; `StoreMismatch` where two sources differ."""
    return common_embodiment(
        [(episode.recording, episode.embodiment) for episode in checked],
        "store",
        "Extract them into two stores: one params file each, with its own data.sources and "
        "extract.store.",
    )


def _refuse_rates(checked: Sequence[CheckedEpisode]) -> None:
    """Raise `StoreMismatch` where the recorded rows have no rate, or more than one."""
    rates = sorted(
        (episode.ticks.recorded_hz, f"{episode.source!r} ({episode.recording.path})")
        for episode in checked
        if episode.ticks.recorded_hz
    )
    if not rates:
        raise StoreMismatch(
            f"data.action_hz is null, and {checked[0].recording.path} and all others have a single "
            "action, which tells no rate: a policy of them could not be served. Set data.action_hz."
        )
    slowest, fastest = rates[0], rates[-1]
    if fastest[0] - slowest[0] > RATE_TOLERANCE * fastest[0]:
        raise StoreMismatch(
            f"data.action_hz is null, and actions come at {slowest[0]:.4g} Hz in source "
            f"{slowest[1]} and at {fastest[0]:.4g} Hz in source {fastest[1]}: a store has ticks of "
            "one length. Set data.action_hz, or extract them into two stores: one params file "
            "each, with its own data.sources and extract.store."
        )


def _checked(
    episode: SurveyedEpisode, data: DataParams, rotation: ActionRotation, preparer: Preparer
) -> CheckedEpisode:
    recording = episode.recording
    read = read_episode(recording, data.action_hz, data.vlm_reuse_count, rotation)
    cameras = recording.cameras()
    try:
        preparer.render(recording.instruction, list(cameras))
    except VLMError as error:
        raise RecordingError(f"{recording.path}: {error}") from None
    for view, camera in cameras.items():
        camera.check(np.unique(read.timeline.frames[view]).tolist())
    rows = (read.timeline, read.readings, read.states)
    checked = CheckedEpisode(*rows, recording.source, episode.text, recording, read.embodiment)
    where = f"{recording.path}, {recording.id}"
    _STORED.parse_json(checked.text, EpisodeText, where)
    _STORED.parse(read.embodiment.document() | {"views": [*cameras]}, Streams, where)
    return checked


def _refuse_bad(bad: Sequence[BadEpisode], total: int) -> None:
    """Raise one `RecordingError` that lists the first bad episodes."""
    lines: list[str] = []
    for episode in bad:
        where = "" if str(episode.where) in episode.reason else f"{episode.where}: "
        lines.append(f"  {episode.source}: {where}{episode.reason}")
    head = f"{len(bad)} of {total} episodes cannot be used:"
    mend = "Mend or remove them, or leave them out with --set data.on_bad_episode=skip."
    raise RecordingError("\n".join([head, *capped(lines, "episodes", MOST_EPISODES), mend]))


def _surveyed(
    recording: Recording, data: DataParams, rotation: ActionRotation, digests: ContentDigests
) -> SurveyedEpisode:
    path = absolute(recording.path)
    with suppress(ValueError):  # relative to the data root where below it: a store can move
        path = path.relative_to(absolute(data.root))
    text = {
        "id": recording.id,
        "path": path.as_posix(),
        "format": recording.format,
        "instruction": recording.instruction,
        "content": _content(recording, digests),
    }
    group = recording.group
    parts = [text["id"], text["format"], text["instruction"], text["path"]]
    if group is not None:
        parts.append(group)
        text["group"] = group
    decides = repr((data.action_hz, data.vlm_reuse_count, rotation))
    digest = joint_digest(text["content"], recording.source, *parts, decides)
    return SurveyedEpisode(recording, text | {"digest": digest}, tuple(recording.view_names()))


_CONTENT_VERSION = 1
"""Raise it whenever `content_digest` changes, because earlier results are remembered."""


def _content(recording: Recording, digests: ContentDigests) -> str:
    """The content digest of a recording, remembered by path, size and mtime of all its files.

    There is one entry per episode: to look up each file would take longer than its `stat`.
    """
    listed = [str(_CONTENT_VERSION), recording.identity(), str(recording.path)]
    folders: dict[str, str] = {}
    places: dict[str, str] = {}
    try:
        for file in map(str, recording.files()):
            status = os.stat(file)  # noqa: PTH116, a tenth of the time of a path's
            folder, _, name = file.rpartition("/")
            if folder not in folders:
                folders[folder] = os.path.realpath(folder)
            places[file] = f"{folders[folder]}/{name}"
            what = f"{status.st_mode} {status.st_size} {status.st_mtime_ns}"
            listed.append(f"{what} {places[file]}")
    except OSError:
        return content_digest(recording, digests.of)  # its error names the file

    def of_place(file: Path) -> str:
        return digests.of(Path(places[str(file)]))

    return digests.text(joint_digest(*listed), lambda: content_digest(recording, of_place))
