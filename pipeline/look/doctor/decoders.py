"""Whether this PyAV decodes the videos of data sets: it is given one frame of each codec."""

import io
from base64 import b64decode

import av

from pipeline.base.config import Params
from pipeline.look.doctor.findings import Finding, note, ok

CLIPS = {
    "AV1": (
        "ivf",
        "REtJRgAAIABBVjAxQABAAAoAAAABAAAAAQAAAAAAAAAeAAAAAAAAAAAAAAASAAoKAAAAAq//iV8gCDIOEADjgiihRQMA"
        "AgGLTxA=",
    ),
    "H.264": (
        "h264",
        "AAAAAWdkAAqs2UQmhAAAAwAEAAADAFA8SJZYAAAAAWjr48siwAAAAWWIhAA3//728P4FMEtFCXEc3ofP0ABVdr2uHiL/"
        "9Uc=",
    ),
    "HEVC": (
        "hevc",
        "AAAAAUABDAH//wFgAAADAJAAAAMAAAMAHpWYCQAAAAFCAQEBYAAAAwCQAAADAAADAB6gIIEFllZpJMrmgIAAAAMAgAAA"
        "BQQAAAABRAHBcrQiQAAAASgBrxGA9JHr/7f0XQDg",
    ),
}
"""A grey picture of 64 x 64 pixels, RGB 100 100 100, by codec: its container and its bytes."""
GREY = 100


def check_decoders(params: Params) -> list[Finding]:
    """Each codec that LeRobot data sets come in; params are not looked at."""
    return [check_decoder(codec) for codec in CLIPS]


def check_decoder(codec: str) -> Finding:
    """One codec. Without AV1, LeRobot's default, its data sets cannot be read."""
    trouble = decoding_trouble(codec)
    if trouble is None:
        return ok(codec, f"decodes (PyAV {av.__version__})")
    remedy = "pip install --upgrade --force-reinstall --only-binary av av"
    if codec == "AV1":
        remedy += " (a wheel, which has libdav1d)"
    return note(codec, f"PyAV {av.__version__} does not decode it: {trouble}", remedy)


def decoding_trouble(codec: str) -> str | None:
    """What goes wrong when a frame is decoded; None where its picture is right."""
    container, content = CLIPS[codec]
    try:
        with av.open(io.BytesIO(b64decode(content)), "r", format=container) as clip:
            frame = next(clip.decode(video=0))
            grey = float(frame.to_ndarray(format="rgb24").mean())
    except (av.FFmpegError, ValueError, StopIteration) as error:
        return str(error) or type(error).__name__
    return None if abs(grey - GREY) < 2 else f"its picture is wrong (grey {grey:.0f}, not {GREY})"
