"""What is not there: streams, cameras, views, frames."""

from collections.abc import Iterator

from pipeline.data.reader import FileRecording
from pipeline.data.recording import Nominal
from pipeline.look.recording.clocks import usual_step
from pipeline.look.recording.facts import EpisodeView, Flaw

COUNT_TOLERANCE = 0.1
"""Share of its frames that a view may lack; two frames are never too few."""
OTHER_RATE = 1.8
"""Times as fast a camera is one of another kind, whose frames are not compared in number."""


def count_flaws(view: EpisodeView, said: Nominal) -> Iterator[Flaw]:
    """Flaws of kind missing, depth view and frame count.

    `said` is what the recording says of itself.
    """
    unread = {name for flaw in view.flaws for name in flaw.stream.split(", ")}
    for name, entry in said.streams.items():
        if name not in view.streams and name not in unread:
            message = f"no file holds it, but {said.where} says {entry}: copy the file, too"
            yield view.flaw("missing", name, message)
    frames = {name: len(camera.time) for name, camera in view.cameras.items()}
    recorded = _recorded_views(view)
    if recorded is not None and not frames:
        left_out = f"; data.views leaves out {', '.join(recorded)}" if recorded else ""
        message = f"no camera has a frame{left_out}: the VLM would see no picture"
        yield view.flaw("missing", "cameras", message)
    empty = [] if recorded is None else view.recording.empty_views()
    for name in empty:
        yield view.flaw("missing", f"view {name}", "its folder is there and holds no frame")
    for name in view.recording.depth_views():
        message = "a depth map by the metadata, no picture: it is no view, the VLM is not shown it"
        yield view.flaw("depth view", f"view {name}", message)
    for name in said.views:
        if name in empty:
            continue
        if recorded is not None and not any(
            n == name or n.startswith(f"{name}_") for n in recorded
        ):
            message = f"no frame; {said.where} lists {', '.join(said.views)}"
            yield view.flaw("missing", f"view {name}", message)
    most = max(frames.values(), default=0)
    if said.frames is not None and _too_few(most, said.frames):
        message = f"{most} frames in the view that has most, {said.where} says {said.frames}"
        yield view.flaw("frame count", "cameras", message)
    for name, found in frames.items():
        expected = max(frames[other] for other in frames if _same_rate(view, name, other))
        if _too_few(found, expected):
            message = f"{found} frames, another view of its rate has {expected}"
            yield view.flaw("frame count", f"view {name}", message)


def _too_few(found: int, expected: int) -> bool:
    return expected - found > max(2, COUNT_TOLERANCE * expected)


def _same_rate(view: EpisodeView, one: str, other: str) -> bool:
    """Whether two cameras may be meant to run alike: a rig can have a slow and a fast one."""
    step, beside = (usual_step(view.cameras[name].time) for name in (one, other))
    return one == other or max(step, beside) < OTHER_RATE * min(step, beside)


def _recorded_views(view: EpisodeView) -> tuple[str, ...] | None:
    """All views of the recording, those that `data.views` leaves out too; None if not readable."""
    one = view.recording
    if not isinstance(one, FileRecording) or any("cameras" in flaw.stream for flaw in view.flaws):
        return None
    return tuple(one.all_views())
