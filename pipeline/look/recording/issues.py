"""Everything that looks wrong in one episode.

Each kind's rule and thresholds stand in `clocks`, `channels` and `frames`; what is not there at
all, here. Most rules look for what is unlike the rest of the same episode, so that no expectation
about the robot is needed.
"""

from collections.abc import Iterator

from pipeline.base.errors import RecordingError
from pipeline.base.issue import Issue
from pipeline.data.reader import FileRecording
from pipeline.data.recording import Nominal
from pipeline.look.recording.channels import find_channel_issues
from pipeline.look.recording.clocks import find_clock_issues, usual_step
from pipeline.look.recording.episode import EpisodeView
from pipeline.look.recording.frames import find_frame_issues

# Share of its frames that a view may lack; two frames are never too few.
COUNT_TOLERANCE = 0.1
# Times as fast a camera is one of another kind, whose frames are not compared in number.
OTHER_RATE = 1.8


def find_issues(view: EpisodeView) -> tuple[Issue, ...]:
    """The issues of this episode, those of reading it included: errors first, then by time."""
    issues = [*view.issues, *_beside_nominal(view)]
    issues += [*find_channel_issues(view), *find_frame_issues(view)]
    return tuple(
        sorted(issues, key=lambda one: (one.severity != "error", one.start_s or float("-inf")))
    )


def _beside_nominal(view: EpisodeView) -> Iterator[Issue]:
    """What is unlike what the recording says of itself, and what clocks show without that."""
    try:
        nominal = view.recording.nominal()
    except RecordingError as error:
        nominal = Nominal()
        # What keeps a stream from being read, too, has been told with it.
        if str(error) not in {issue.message for issue in view.issues}:
            yield view.issue("unreadable", "metadata", str(error))
    for mistake in nominal.mistakes:
        yield view.issue("wrong metadata", "", mistake)
    yield from find_clock_issues(view, nominal)
    yield from _missing(view, nominal)
    yield from _frame_counts(view, nominal)


def _missing(view: EpisodeView, nominal: Nominal) -> Iterator[Issue]:
    """Streams, cameras and views that are not there, or are no views."""
    unread = {name for issue in view.issues for name in issue.stream.split(", ")}
    for name, entry in nominal.streams.items():
        if name not in view.streams and name not in unread:
            message = f"no file holds it, but {nominal.where} says {entry}: copy the file, too"
            yield view.issue("missing", name, message)
    for name in view.recording.depth_views():
        message = "a depth map by the metadata, no picture: it is no view, the VLM is not shown it"
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
    for name in {*nominal.views} - {*empty}:
        if not any(other == name or other.startswith(f"{name}_") for other in recorded):
            message = f"no frame; {nominal.where} lists {', '.join(nominal.views)}"
            yield view.issue("missing", f"view {name}", message)


def _frame_counts(view: EpisodeView, nominal: Nominal) -> Iterator[Issue]:
    """Too few frames, by the metadata or beside another view of the same rate."""
    frames = {name: len(camera.time) for name, camera in view.cameras.items()}
    steps = {name: usual_step(camera.time) for name, camera in view.cameras.items()}
    most = max(frames.values(), default=0)
    if nominal.frames is not None and _too_few(most, nominal.frames):
        message = f"{most} frames in the view that has most, {nominal.where} says {nominal.frames}"
        yield view.issue("frame count", "cameras", message)
    for name, count in frames.items():
        # A rig can have a slow and a fast camera.
        expected = max(
            frames[other]
            for other, step in steps.items()
            if other == name or max(step, steps[name]) < OTHER_RATE * min(step, steps[name])
        )
        if _too_few(count, expected):
            message = f"{count} frames, another view of its rate has {expected}"
            yield view.issue("frame count", f"view {name}", message)


def _too_few(count: int, expected: int) -> bool:
    return expected - count > max(2, COUNT_TOLERANCE * expected)
