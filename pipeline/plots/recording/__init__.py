"""One recording, and what training sees of it -> pictures.

Times are drawn in seconds since the recording's first instant. A recording of any length is drawn
in about a second: what has more entries than the paper has dots is thinned, and says so.
"""

from pipeline.plots.recording.frames import camera_views
from pipeline.plots.recording.lanes import clock_lanes
from pipeline.plots.recording.masks import batch
from pipeline.plots.recording.side_by_side import samples
from pipeline.plots.recording.steps import clock_steps
from pipeline.plots.recording.streams import motion, sensor

__all__ = [
    "batch",
    "camera_views",
    "clock_lanes",
    "clock_steps",
    "motion",
    "samples",
    "sensor",
]
