"""Which rows of a build become golden rows, and their frames decoded once more."""

from collections.abc import Iterator

import numpy as np

from pipeline.base.golden import spread
from pipeline.extract.engine import row_frames
from pipeline.extract.plan import Say
from pipeline.extract.survey import Survey
from pipeline.store import GoldenFrames, StoreBuild
from pipeline.vlm.preparation import Preparer


def keep_golden(build: StoreBuild, surveyed: Survey, say: Say) -> None:
    """Write the golden rows of a build whose rows are all there: at most four, evenly spread.

    Where the decoder of today gives other pixels than a row was computed from, that row is left out
    and `say` told. Raises `RecordingError` where a recording has gone, and `DiskFull`.
    """
    if left_out := build.write_golden(_golden_frames(build, surveyed)):
        say(
            f"{left_out} golden row(s) left out: decoded today, their frames are other pixels than "
            "those that the stored features were computed from (stages.verify --reextract tells "
            "how far the features are apart)"
        )


def _golden_frames(build: StoreBuild, surveyed: Survey) -> Iterator[GoldenFrames]:
    frames = row_frames(build, surveyed)
    views = np.isfinite(frames.frame_time).sum(axis=1)
    preparer = Preparer(surveyed.params.vlm, surveyed.spec)
    for part in frames.ranges(spread(np.arange(len(views)), views)):
        prompt = preparer.render(part.recording.instruction, list(part.frames))
        for row, decoded in part.read():
            yield GoldenFrames(row, prompt, decoded)
