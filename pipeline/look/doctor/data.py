"""Whether the recordings are there, and can be read."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import av

from pipeline.base.config import Params, Source
from pipeline.base.errors import RecordingError
from pipeline.base.issue import Issue
from pipeline.data import Opened, open_recordings
from pipeline.look.doctor import missing, note, ok

DECODERS = {"AV1": "libdav1d", "H.264": "h264", "HEVC": "hevc"}
"""What decodes the codecs that LeRobot data sets come in, AV1 by default."""
_WHEEL = "pip install --upgrade --force-reinstall --only-binary av av"
_VIDEOS = {".mp4", ".mkv", ".avi", ".mov", ".webm"}


def check(params: Params) -> Iterator[Issue]:
    """`data.root` and each source; metadata is read, and one frame of a video."""
    yield check_decoders(av.codecs_available)
    data = params.data
    demo = "python -m stages.demo (or dvc repro)" if data.root == params.demo.recordings else ""
    relative = any(not Path(path).is_absolute() for source in data.sources for path in source.paths)
    if relative and not data.root.is_dir():
        text = f"{data.root}: no such folder"
        yield missing("data.root", text, demo or "set data.root to the folder of recordings")
        return
    yield ok("data.root", str(data.root))
    for source in data.sources:
        try:
            opened = open_recordings([source], data.root, data.views)
        except RecordingError as error:
            yield missing(source.name, str(error), demo or "mend data.sources")
        else:
            yield from check_source(source, opened, data.on_bad_episode)


def check_decoders(available: set[str]) -> Issue:
    """The video codecs; without AV1, most LeRobot data sets cannot be read."""
    lacking = [codec for codec, decoder in DECODERS.items() if decoder not in available]
    if lacking:
        text = f"PyAV {av.__version__} does not decode {', '.join(lacking)}"
        return note("video", text, f"{_WHEEL} (a wheel, which has libdav1d)")
    return ok("video", f"PyAV {av.__version__} decodes {', '.join(DECODERS)}")


def check_source(source: Source, opened: Opened, on_bad: str) -> Iterator[Issue]:
    """What a source holds, what of it cannot be read, and whether DVC sees it."""
    formats = Counter(recording.format for recording in opened.recordings)
    text = ", ".join(f"{count} episode(s), {name}" for name, count in formats.items())
    # The old format keeps its instruction in a pickle, which takes long to open.
    quick = [recording for recording in opened.recordings if recording.format != "old"]
    told = f', told "{quick[0].instruction}"' if quick else ""
    yield ok(source.name, f"{text or 'no episode'}{told}")
    if opened.bad:
        first = f"{len(opened.bad)} episode(s) cannot be read, first: {opened.bad[0].reason}"
        yield unusable(source.name, first, on_bad)
    if opened.missing:
        text = f"{len(opened.missing)} listed episode(s) are not there: {opened.missing[0]}"
        yield note(source.name, text, "copy them too, or leave them out")
    outside = [path for path in source.paths if Path(path).is_absolute()]
    if outside:
        text = f"{outside[0]} is absolute, so DVC does not watch it"
        yield note(source.name, text, "lay it below data.root, for dvc repro")
    lerobot = [episode for episode in opened.recordings if episode.format == "lerobot"]
    videos = [file for episode in lerobot[:1] for file in episode.files() if file.suffix in _VIDEOS]
    if videos:
        yield check_video(source.name, videos[0])


def unusable(subject: str, message: str, on_bad: str) -> Issue:
    """What is said of episodes that cannot be used: they are left out, or nothing runs."""
    if on_bad == "skip":
        return note(subject, message, "left out, as data.on_bad_episode says")
    return missing(subject, message, "mend or remove them, or set data.on_bad_episode=skip")


def check_video(source: str, path: Path) -> Issue:
    """Whether this PyAV decodes the first frame of a video."""
    codec = "unknown codec"
    try:
        with av.open(str(path)) as container:
            codec = container.streams.video[0].codec_context.codec.canonical_name
            next(container.decode(video=0))
    except (av.FFmpegError, OSError, IndexError, StopIteration) as error:
        text = f"{path}: its video ({codec}) is not decoded: {error or 'it has no frame'}"
        return missing(source, text, f"copy it again, or {_WHEEL}")
    return ok(source, f"its videos are {codec}")
