"""Whether the recordings are there and can be read."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.base.commands import command
from pipeline.base.config import MediaLimits, Params, Source
from pipeline.base.errors import ConfigError, Issue, RecordingError
from pipeline.data import Opened, Recording, open_recordings
from pipeline.data.recording import DEFAULT_LIMITS
from pipeline.data.video import opened_video
from pipeline.look.doctor import missing, note, ok

_WHEEL = "pip install --upgrade --force-reinstall --only-binary av av"
_EPISODES = 4
"""The most episodes that are read of each source."""
_VIDEOS = {".mp4", ".mkv", ".avi", ".mov", ".webm"}


def check_recordings(params: Params) -> Iterator[Issue]:
    """Check `data.root` and each source: its metadata, a few episodes, and one frame of a video."""
    data = params.data
    demo = f"{command('demo')} (or dvc repro)" if data.root == params.demo.recordings else ""
    relative = any(not Path(path).is_absolute() for source in data.sources for path in source.paths)
    if relative and not data.root.is_dir():
        text = f"{data.root}: no such folder"
        yield missing("data.root", text, demo or "set data.root to the folder of recordings")
        return
    yield ok("data.root", str(data.root))
    for source in data.sources:
        try:
            opened = open_recordings([source], data.root, data.views)
        except (ConfigError, RecordingError) as error:
            yield missing(source.name, str(error), demo or "mend data.sources")
        else:
            yield from check_source(source, opened, data.on_bad_episode)


def check_source(source: Source, opened: Opened, on_bad: str) -> Iterator[Issue]:
    """The episodes of a source, those that cannot be read, and whether its videos decode."""
    formats = Counter(recording.format for recording in opened.recordings)
    text = ", ".join(f"{count} episode(s), {name}" for name, count in formats.items())
    yield ok(source.name, text or "no episode")
    if bad := [*(bad.reason for bad in opened.bad), *_unreadable(opened.recordings)]:
        first = f"{len(bad)} episode(s) cannot be read, first: {bad[0]}"
        if on_bad == "skip":
            yield note(source.name, first, "left out, as data.on_bad_episode says")
        else:
            remedy = "mend or remove them, or set data.on_bad_episode=skip"
            yield missing(source.name, first, remedy)
    if opened.missing:
        text = f"{len(opened.missing)} listed episode(s) are not there: {opened.missing[0]}"
        yield note(source.name, text, "copy them too, or leave them out")
    lerobot = [episode for episode in opened.recordings if episode.format == "lerobot"]
    videos = [file for episode in lerobot[:1] for file in episode.files() if file.suffix in _VIDEOS]
    if videos:
        yield check_video(source.name, videos[0], source.limits)


def _unreadable(recordings: Sequence[Recording]) -> Iterator[str]:
    """Reads a few evenly spread recordings; yields why one cannot be read."""
    spread = np.linspace(0, len(recordings) - 1, min(_EPISODES, len(recordings)))
    for recording in (recordings[int(place)] for place in spread):
        try:
            motion = recording.poses if recording.has_poses else recording.action
            for read in (recording.state, recording.sensor, motion):
                read()
            for camera in recording.cameras().values():
                camera.check(range(min(1, len(camera.time))))
        except RecordingError as error:
            yield str(error)


def check_video(source: str, path: Path, limits: MediaLimits = DEFAULT_LIMITS) -> Issue:
    """Whether this PyAV decodes the first frame of a video."""
    try:
        with opened_video(path, limits) as (container, stream):
            if next(container.decode(stream), None) is None:
                raise RecordingError(f"{path}: its video has no frame")
            return ok(source, f"its videos are {stream.codec_context.codec.canonical_name}")
    except RecordingError as error:
        return missing(source, str(error), f"copy it again, or {_WHEEL}")
