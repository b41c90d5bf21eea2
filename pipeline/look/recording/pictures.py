"""One recording, and what training sees of it -> pictures.

Times are drawn in seconds since the recording's first instant. A recording of any length is drawn
in about a second: what has more entries than the paper has dots is thinned, and says so.
"""

from pipeline.look.recording.draw_frames import camera_views
from pipeline.look.recording.draw_lanes import clock_lanes
from pipeline.look.recording.draw_masks import batch
from pipeline.look.recording.draw_side_by_side import samples
from pipeline.look.recording.draw_steps import clock_steps
from pipeline.look.recording.draw_streams import motion, sensor

__all__ = [
    "batch",
    "camera_views",
    "clock_lanes",
    "clock_steps",
    "motion",
    "samples",
    "sensor",
]
