"""Every recording read and checked, one in memory at a time.

The rules and thresholds of most issues stand in `clocks`, `channels` and `cameras`; here are those
of what is missing, and of several recordings. Most rules look for what is unlike the rest of the
same episode, so they expect nothing of the robot.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import blake2b
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.errors import RecordingError, StoreMismatch
from pipeline.base.issue import Issue
from pipeline.data import Opened, Recording
from pipeline.data.embodiment import Embodiment, common_embodiment
from pipeline.data.reader import FileRecording
from pipeline.data.recording import Nominal
from pipeline.data.timeline import ActionRotation, choose_action_rotation, rate_notes
from pipeline.look.recording.cameras import find_frame_issues
from pipeline.look.recording.channels import find_channel_issues
from pipeline.look.recording.clocks import find_clock_issues
from pipeline.look.recording.episode import EpisodeView, view_episode

_warning = partial(Issue, severity="warning")


@dataclass
class RecordingSummary:
    """One recording in a line.

    `counts` are entries by clock (`EpisodeView.clocks`), `digests` those of its motion by stream.
    """

    source: str
    episode: str
    format: str
    path: Path
    instruction: str | None
    duration_s: float
    ticks: int
    vl_rows: int
    counts: Mapping[str, int]
    digests: Mapping[str, str]
    issues: list[Issue]

    @property
    def frames(self) -> dict[str, int]:
        """Number of frames by view."""
        views = {name: count for name, count in self.counts.items() if name.startswith("view ")}
        return {name.removeprefix("view "): count for name, count in views.items()}

    @property
    def errors(self) -> int:
        """Number of errors among its issues."""
        return sum(issue.severity == "error" for issue in self.issues)

    @property
    def warnings(self) -> int:
        """Number of warnings among its issues."""
        return len(self.issues) - self.errors

    def warn(self, kind: str, stream: str, message: str) -> None:
        """Add a warning."""
        source, episode = self.source, self.episode
        self.issues.append(
            _warning(kind=kind, message=message, source=source, episode=episode, stream=stream)
        )


@dataclass(frozen=True)
class RecordingsOverview:
    """All recordings that were opened, and everything that is wrong with them.

    `summaries` stand in the order in which recordings were opened; `common` are the issues of whole
    sources and of recordings that could not be opened; `rotation` is the kind of rotation that
    `data.action_rotation` gives for these recordings.
    """

    summaries: tuple[RecordingSummary, ...]
    common: tuple[Issue, ...]
    rotation: ActionRotation

    @property
    def issues(self) -> tuple[Issue, ...]:
        """The common ones, then episode by episode."""
        return (*self.common, *(issue for summary in self.summaries for issue in summary.issues))

    @property
    def views(self) -> tuple[str, ...]:
        """The views of all recordings, sorted."""
        return tuple(sorted({view for summary in self.summaries for view in summary.frames}))

    def choose(self, count: int) -> tuple[int, ...]:
        """At most `count` places in `summaries` to look at closely, in their order.

        Those with most errors, then most warnings, come first; the others are evenly spread.
        """
        ranked = worst_first(self.summaries)
        worst = [place for place in ranked if self.summaries[place].issues][:count]
        sound = [place for place in range(len(self.summaries)) if place not in worst]
        left = min(count - len(worst), len(sound))
        spread = np.linspace(0, len(sound) - 1, left).round().astype(int).tolist() if left else []
        return tuple(sorted([*worst, *(sound[place] for place in spread)]))


def worst_first(summaries: Sequence[RecordingSummary]) -> list[int]:
    """Their places, those with most errors, then most warnings, first."""
    counts = [(-summary.errors, -summary.warnings) for summary in summaries]
    return sorted(range(len(summaries)), key=counts.__getitem__)


def survey_recordings(opened: Opened, params: Params) -> RecordingsOverview:
    """Read and check every recording; a broken one keeps no other from being read.

    Raises `ConfigError` where poses need `data.action_hz`.
    """
    rotation = choose_action_rotation(params.data.action_rotation, opened.recordings)
    summaries: list[RecordingSummary] = []
    embodiments: list[tuple[Recording, Embodiment]] = []
    rates: list[tuple[str, float | None, float]] = []
    for recording in tqdm(opened.recordings, "inspecting", unit="episode", disable=None):
        view = view_episode(recording, params.data, rotation)
        summaries.append(_summarise(view))
        if (line := view.timeline) is not None:
            kind = Embodiment.of(line.action_channels, line.action_kind, view.sensor, view.state)
            embodiments.append((recording, kind))
            rates.append((recording.source, line.recorded_hz, line.fastest_hz))
    _warn_of_duplicates(summaries)
    common = list(_not_opened(opened))
    try:
        if embodiments:
            common_embodiment(embodiments, "store", "Inspect and extract them apart.")
    except StoreMismatch as error:
        common.append(Issue(severity="error", kind="embodiment", message=str(error)))
    # Where ticks are not the recorded rows.
    for source, note in rate_notes(rates, params.data.action_hz).items():
        note += "; with data.action_hz null the recorded rows are the ticks"
        common.append(_warning(kind="tick rate", message=note, source=source, stream="ticks"))
    return RecordingsOverview(tuple(summaries), tuple(common), rotation)


def _summarise(view: EpisodeView) -> RecordingSummary:
    recording, line = view.recording, view.timeline
    return RecordingSummary(
        source=recording.source,
        episode=recording.id,
        format=recording.format,
        path=recording.path,
        instruction=view.instruction,
        duration_s=view.duration_s,
        ticks=0 if line is None else len(line.time),
        vl_rows=0 if line is None else len(line.vl_time),
        counts={name: len(time) for name, time in view.clocks.items()},
        digests=_digest_motion(view),
        issues=list(find_issues(view)),
    )


def find_issues(view: EpisodeView) -> tuple[Issue, ...]:
    """The issues of this episode, those of reading it included: errors first, then by time."""
    issues = [*view.issues, *_beside_nominal(view)]
    issues += [*find_channel_issues(view), *find_frame_issues(view)]
    issues.sort(key=lambda issue: (issue.severity != "error", issue.start_s or float("-inf")))
    return tuple(issues)


def _beside_nominal(view: EpisodeView) -> Iterator[Issue]:
    """Issues of clocks and missing streams, by what the recording says of itself."""
    try:
        nominal = view.recording.nominal()
    except RecordingError as error:
        nominal = Nominal()
        # The same file may be the reason why a stream cannot be read.
        if str(error) not in {issue.message for issue in view.issues}:
            yield view.issue("unreadable", "metadata", str(error))
    for mistake in nominal.mistakes:
        yield view.issue("wrong metadata", "", mistake)
    yield from find_clock_issues(view, nominal)
    yield from _missing(view, nominal)


def _missing(view: EpisodeView, nominal: Nominal) -> Iterator[Issue]:
    """Streams, cameras and views that are missing, and depth maps, which are no views."""
    unread = {name for issue in view.issues for name in issue.stream.split(", ")}
    for name, entry in nominal.streams.items():
        if name not in view.streams and name not in unread:
            message = f"no file holds it, but {nominal.where} says {entry}: copy the file, too"
            yield view.issue("missing", name, message)
    for name in view.recording.depth_views():
        message = "a depth map by the metadata, no picture: it is no view, the VLM does not see it"
        yield view.issue("depth view", f"view {name}", message)
    if not isinstance(view.recording, FileRecording) or "cameras" in unread:
        return
    # Those that `data.views` leaves out, too.
    recorded, empty = view.recording.all_views(), view.recording.empty_views()
    if not view.cameras:
        left_out = f"; data.views leaves out {', '.join(recorded)}" if recorded else ""
        message = f"no camera has a frame{left_out}: the VLM would see no picture"
        yield view.issue("missing", "cameras", message)
    for name in empty:
        yield view.issue("missing", f"view {name}", "its folder is there and holds no frame")


def _digest_motion(view: EpisodeView) -> dict[str, str]:
    """Digests of the values of state and action, or of the sensor without either.

    Streams that never change are left out: they can be equal by chance. So are clocks: two formats
    give the same rows different times.
    """
    motion = {name: view.streams[name] for name in ("state", "action") if name in view.streams}
    streams = motion or ({} if view.sensor is None else {"sensor": view.sensor})
    return {
        name: blake2b(stream.values.tobytes(), digest_size=16).hexdigest()
        for name, stream in streams.items()
        if np.ptp(stream.values, axis=0).any()
    }


def _warn_of_duplicates(summaries: Sequence[RecordingSummary]) -> None:
    """Warn of episodes whose streams have the values of an earlier one, where both have them."""
    firsts: dict[tuple[str, str], list[RecordingSummary]] = defaultdict(list)
    for summary in summaries:
        for first in (first for digest in summary.digests.items() for first in firsts[digest]):
            common = sorted(summary.digests.keys() & first.digests.keys(), reverse=True)
            if all(summary.digests[name] == first.digests[name] for name in common):
                source = "" if first.source == summary.source else f"{first.source}/"
                named = f"{source}{first.episode} ({first.path})"
                equal = f"all values of {' and '.join(common)} are equal"
                message = f"the same recording as {named}: {equal}, and nothing else was compared"
                summary.warn("duplicate recording", "", message)
                break
        else:
            for digest in summary.digests.items():
                firsts[digest].append(summary)


def _not_opened(opened: Opened) -> Iterator[Issue]:
    error = partial(Issue, severity="error", kind="unreadable")
    for bad in opened.bad:
        yield error(message=bad.reason, source=bad.source, episode=bad.where.name)
    for line in opened.missing:
        source, _, message = line.partition(": ")
        yield _warning(kind="missing", message=message, source=source)
