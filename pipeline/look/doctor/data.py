"""Whether the recordings are there, and can be read."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import av

from pipeline.base.config import Params, Source
from pipeline.base.errors import RecordingError
from pipeline.data import Opened, Recording, open_recordings
from pipeline.look.doctor.decoders import CLIPS, decoding_trouble
from pipeline.look.doctor.findings import Finding, missing, note, ok

_CODECS = {"av1": "AV1", "h264": "H.264", "hevc": "HEVC"}
_VIDEOS = {".mp4", ".mkv", ".avi", ".mov", ".webm"}


def check_data(params: Params) -> list[Finding]:
    """`data.root` and each source; metadata is read, no stream and no frame."""
    data = params.data
    demo = "python -m stages.demo (or dvc repro)" if data.root == params.demo.recordings else ""
    relative = any(not Path(path).is_absolute() for one in data.sources for path in one.paths)
    if relative and not data.root.is_dir():
        said = f"{data.root}: no such folder"
        return [missing("data.root", said, demo or "set data.root to the folder of recordings")]
    findings = [ok("data.root", str(data.root))]
    for source in data.sources:
        try:
            opened = open_recordings([source], data.root, data.views)
        except RecordingError as error:
            findings.append(missing(source.name, str(error), demo or "mend data.sources"))
            continue
        findings += check_source(source, opened, data.on_bad_episode, decoding_trouble)
    return findings


def check_source(
    source: Source, opened: Opened, on_bad: str, trouble: Callable[[str], str | None]
) -> list[Finding]:
    """What a source holds, what of it cannot be read, and whether DVC sees it."""
    formats = Counter(recording.format for recording in opened.recordings)
    said = ", ".join(f"{count} episode(s), {name}" for name, count in formats.items())
    findings = [ok(source.name, f"{said or 'no episode'}{_first_instruction(opened.recordings)}")]
    if opened.bad:
        first = f"{len(opened.bad)} episode(s) cannot be read, first: {opened.bad[0].reason}"
        findings.append(unusable(source.name, first, on_bad))
    if opened.missing:
        said = f"{len(opened.missing)} listed episode(s) are not there: {opened.missing[0]}"
        findings.append(note(source.name, said, "copy them too, or leave them out"))
    outside = [path for path in source.paths if Path(path).is_absolute()]
    if outside:
        said = f"{outside[0]} is absolute, so DVC does not watch it"
        findings.append(note(source.name, said, "lay it below data.root, for dvc repro"))
    video = _first_video(opened.recordings)
    return findings if video is None else [*findings, check_video(source.name, video, trouble)]


def unusable(subject: str, found: str, on_bad: str) -> Finding:
    """What is said of episodes that cannot be used: they are left out, or nothing runs."""
    if on_bad == "skip":
        return note(subject, found, "left out, as data.on_bad_episode says")
    return missing(subject, found, "mend or remove them, or set data.on_bad_episode=skip")


def check_video(source: str, path: Path, trouble: Callable[[str], str | None]) -> Finding:
    """Whether this PyAV decodes the codec of a video."""
    try:
        with av.open(str(path)) as container:
            name = container.streams.video[0].codec_context.codec.canonical_name
    except (av.FFmpegError, OSError, IndexError) as error:
        return missing(source, f"{path}: cannot be read as video: {error}", "copy it again")
    codec = _CODECS.get(name, name)
    why = trouble(codec) if codec in CLIPS else None
    if why is None:
        return ok(source, f"its videos are {codec}")
    said = f"its videos are {codec}, which this PyAV does not decode: {why}"
    return missing(source, said, "pip install --upgrade --force-reinstall --only-binary av av")


def _first_instruction(recordings: Sequence[Recording]) -> str:
    # The old format keeps it in a pickle, which takes long to open.
    for recording in recordings:
        if recording.format != "old":
            return f', told "{recording.instruction}"'
    return ""


def _first_video(recordings: Sequence[Recording]) -> Path | None:
    for recording in recordings:
        if recording.format == "lerobot":
            return next((file for file in recording.files() if file.suffix in _VIDEOS), None)
    return None
