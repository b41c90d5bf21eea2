"""What a recording says of itself, to hold beside what is found."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.errors import RecordingError
from pipeline.inspection.facts import EpisodeView
from pipeline.recordings.arrays import number, read_json
from pipeline.recordings.windowed import MARKER


@dataclass(frozen=True)
class Said:
    """Entries are there only where the recording has them."""

    rates_hz: Mapping[str, float]
    """By clock: `sensor`, `state`, `action`, `view View1`, …"""
    views: tuple[str, ...]
    frames: int | None
    """Of the view that has most."""
    where: str
    """The file that says so."""


def said_by(view: EpisodeView) -> Said:
    """What `metadata.json` of the new format says, or `fps` of a LeRobot data set."""
    one = view.recording
    if one.format == "new":
        path = one.path / MARKER
        try:
            return _of_metadata(read_json(path), str(path))
        except RecordingError:
            return Said({}, (), None, str(path))  # the reader has refused it: there is a flaw
    if one.format == "lerobot" and view.action is not None and view.action.rate_hz is not None:
        rows = [name for name in view.clocks if name not in ("sensor", "poses")]
        return Said(dict.fromkeys(rows, view.action.rate_hz), (), None, "meta/info.json")
    return Said({}, (), None, "")


def _of_metadata(metadata: Mapping[str, Any], where: str) -> Said:
    told = {
        "sensor": number(metadata, "sensor_hz", where, positive=True),
        "state": number(metadata, "robot_hz", where, positive=True),
    }
    frames = number(metadata, "camera_frames_count", where)
    listed = metadata.get("camera_views")
    views = tuple(map(str, listed)) if isinstance(listed, list) else ()
    return Said(
        {name: rate for name, rate in told.items() if rate is not None},
        views,
        None if frames is None else int(frames),
        MARKER,
    )
