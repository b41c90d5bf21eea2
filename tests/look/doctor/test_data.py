"""Recordings: there, absent, broken, in a codec that is not decoded."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from pipeline.base.config import Params, Source
from pipeline.data import BadEpisode, open_recordings
from pipeline.look.doctor.data import check_data, check_source, check_video


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
    root, raw, lerobot, outside, videos = check_data(given)
    assert {root.level, raw.level, lerobot.level, videos.level} == {"ok"}
    assert raw.found.startswith('2 episode(s), raw, told "')
    assert "2 episode(s), lerobot" in lerobot.found
    assert outside.level == "note" and "DVC does not watch it" in outside.found
    assert videos.found.startswith("its videos are ")


def test_what_is_not_there_is_missing(recordings: Path) -> None:
    (root,) = check_data(params(recordings / "nowhere", {"name": "a", "path": "a"}))
    assert root.level == "missing" and "nowhere: no such folder" in root.found
    _, source = check_data(params(recordings, {"name": "monday", "path": "2025-*"}))
    assert (source.level, source.subject) == ("missing", "monday")
    assert "matches nothing" in source.found


def test_the_demos_recordings_are_made_by_its_stage(tmp_path: Path) -> None:
    given = params(Path("elsewhere"), {"name": "a", "path": "a"})
    (finding,) = check_data(given)
    assert "stages.demo" in finding.remedy


@pytest.mark.parametrize(("on_bad", "level"), [("stop", "missing"), ("skip", "note")])
def test_episodes_that_cannot_be_read(recordings: Path, on_bad: str, level: str) -> None:
    source = Source(name="raw", path="raw")
    opened = open_recordings([source], recordings)
    bad = BadEpisode("raw", Path("raw/x"), "robot_state_1.csv is empty")
    broken = replace(opened, bad=(bad,), missing=("episode 7",))
    good, unread, absent = check_source(source, broken, on_bad, lambda codec: None)
    assert (good.level, unread.level, absent.level) == ("ok", level, "note")
    assert "1 episode(s) cannot be read, first: robot_state_1.csv is empty" in unread.found
    assert "data.on_bad_episode" in unread.remedy
    assert "episode 7" in absent.found


def test_a_codec_that_is_not_decoded_is_missing(tmp_path: Path) -> None:
    video = tmp_path / "clip.mp4"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libsvtav1", rate=10)
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8))
        container.mux([*stream.encode(frame), *stream.encode()])
    good = check_video("cameras", video, lambda codec: None)
    assert (good.level, good.found) == ("ok", "its videos are AV1")
    bad = check_video("cameras", video, lambda codec: f"no decoder for {codec}")
    assert bad.level == "missing"
    assert "does not decode: no decoder for AV1" in bad.found
    (tmp_path / "cut.mp4").write_bytes(video.read_bytes()[:40])
    assert check_video("cameras", tmp_path / "cut.mp4", lambda codec: None).level == "missing"
