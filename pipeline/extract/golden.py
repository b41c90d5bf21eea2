"""Choose the golden rows of a build; frames come from the previous store, or are decoded."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.base.source import spread
from pipeline.data.episode import RowFrames
from pipeline.extract.rows import row_frames
from pipeline.extract.state import Say, StorePlaces
from pipeline.extract.survey import Survey
from pipeline.store import GoldenFrames, StoreBuild
from pipeline.store.golden import carried_golden
from pipeline.store.schema import KEYS
from pipeline.vlm.preparation import Preparer


def keep_golden(build: StoreBuild, surveyed: Survey, places: StorePlaces, say: Say) -> None:
    """Write the golden rows of a build that has all its rows: at most four, evenly spread.

    Rows that the previous store has are copied from it, the others are decoded. A row is left out,
    and `say` prints that, if its frames now decode to other pixels than when it was computed.
    Raises `RecordingError` where a recording is gone, and `DiskFull`.
    """
    frames = row_frames(build, surveyed)
    views = np.isfinite(frames.frame_time).sum(axis=1)
    chosen = spread(np.arange(len(views)), views)
    carried = _carried(build, surveyed, places)
    taken = [carried.pop(row) for row in chosen.tolist() if row in carried]
    wanted = np.setdiff1d(chosen, [golden.row for golden in taken])
    if left_out := build.write_golden([*taken, *_decoded(frames, wanted, surveyed)]):
        say(
            f"{left_out} golden row(s) left out: decoded today, their frames are other pixels than "
            "those that the stored features were computed from (stages.verify --reextract tells "
            "how far the features are apart)"
        )


def _carried(build: StoreBuild, surveyed: Survey, places: StorePlaces) -> dict[int, GoldenFrames]:
    """The golden frames, by row, of the current store and the previous one.

    A store under repair counts too: damaged frames do not give their key and are left out.
    """
    keys = build.files(KEYS).read(0, build.specs[KEYS].shape[0])
    carried: dict[int, GoldenFrames] = {}
    for store in places.stores:
        for golden in carried_golden(store, surveyed.spec.attrs(), keys):
            carried.setdefault(golden.row, golden)
    return carried


def _decoded(
    frames: RowFrames, rows: NDArray[np.int64], surveyed: Survey
) -> Iterator[GoldenFrames]:
    preparer = Preparer(surveyed.params.vlm, surveyed.spec)
    for part in frames.ranges(rows):
        prompt = preparer.render(part.recording.instruction, list(part.frames))
        for row, decoded in part.read():
            yield GoldenFrames(row, prompt, decoded)
