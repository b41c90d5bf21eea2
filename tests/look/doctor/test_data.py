"""Recordings: there, absent, broken, in a codec that is not decoded."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from pipeline.base.config import Params, Source
from pipeline.data import BadEpisode, open_recordings
from pipeline.look.doctor.data import check_recordings, check_source, check_video


def params(root: Path, *sources: dict[str, Any], **data: Any) -> Params:
    return Params.model_validate(
        {
            "demo": {"recordings": "elsewhere"},
            "data": {"root": str(root), "sources": list(sources), **data},
            "vlm": {"checkpoint": "a/b"},
        }
    )


def test_sources_are_counted_and_the_videos_codec_is_named(recordings: Path) -> None:
    given = params(
        recordings,
        {"name": "raw", "path": "raw"},
        {"name": "lerobot", "path": str(recordings / "lerobot")},
    )
    root, raw, lerobot, videos = check_recordings(given)
    assert {root.severity, raw.severity, lerobot.severity, videos.severity} == {"ok"}
    assert raw.message.startswith("2 episode(s), raw")
    assert "1 episode(s), lerobot" in lerobot.message
    assert videos.message.startswith("its videos are ")


def test_what_is_not_there_is_missing(recordings: Path) -> None:
    (root,) = check_recordings(params(recordings / "nowhere", {"name": "a", "path": "a"}))
    assert root.severity == "error" and str(recordings / "nowhere") in root.message
    *_, source = check_recordings(params(recordings, {"name": "monday", "path": "2025-*"}))
    assert (source.severity, source.kind) == ("error", "monday")
    *_, demo = check_recordings(params(Path("elsewhere"), {"name": "a", "path": "a"}))
    assert "stages.demo" in demo.remedy


@pytest.mark.parametrize(("on_bad", "level"), [("stop", "error"), ("skip", "note")])
def test_episodes_that_cannot_be_read(recordings: Path, on_bad: str, level: str) -> None:
    source = Source(name="raw", path="raw")
    opened = open_recordings([source], recordings)
    bad = BadEpisode("raw", Path("raw/x"), "robot_state_1.csv is empty")
    broken = replace(opened, bad=(bad,), missing=("episode 7",))
    good, unread, absent = check_source(source, broken, on_bad)
    assert (good.severity, unread.severity, absent.severity) == ("ok", level, "note")
    assert "1 episode(s) cannot be read, first: robot_state_1.csv is empty" in unread.message
    assert "data.on_bad_episode" in unread.remedy
    assert "episode 7" in absent.message


def test_a_video_that_is_not_decoded_is_missing(tmp_path: Path) -> None:
    video = tmp_path / "clip.mp4"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libsvtav1", rate=10)
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8))
        container.mux([*stream.encode(frame), *stream.encode()])
    good = check_video("cameras", video)
    assert (good.severity, good.message) == ("ok", "its videos are av1")
    (tmp_path / "cut.mp4").write_bytes(video.read_bytes()[:40])
    assert check_video("cameras", tmp_path / "cut.mp4").severity == "error"


def test_an_episode_whose_arrays_are_cut_off_is_told(recordings: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(recordings / "raw", tmp_path / "raw"))
    path = sorted(root.rglob("sensor_data*.npz"))[-1]
    path.write_bytes(path.read_bytes()[:-2000])
    *_, issue = check_recordings(params(tmp_path, {"name": "raw", "path": "raw"}))
    assert issue.severity == "error" and "1 episode(s) cannot be read" in issue.message
    assert path.name in issue.message
