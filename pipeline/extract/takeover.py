"""Feature rows of frames that an earlier store or build has seen, without decoding one."""

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from pipeline.extract.commits import TOGETHER, commit_known
from pipeline.extract.rows import KnownRow
from pipeline.extract.work import Work
from pipeline.store import RowSource


def take_over(work: Work, layout: RowSource) -> NDArray[np.int64]:
    """Commit the missing rows that donors know by content, instruction and frame times.

    Returns their numbers. `layout` is the build itself, which says what its episodes are.
    """
    taken: list[int] = []
    known = _known(work, layout)
    while block := list(islice(known, TOGETHER)):
        work.done(commit_known(work.build, block))
        taken += [one.row for one in block]
    return np.array(taken, np.int64)


def _known(work: Work, layout: RowSource) -> Iterator[KnownRow]:
    missing = set(work.missing.tolist())
    for episode, (content, instruction) in enumerate(layout.episode_said):
        keys = [(donor, donor.keys_of(content, instruction)) for donor in work.donors]
        for row in range(*work.vl_start[episode : episode + 2]):
            if row in missing and (found := _of_row(row, work.frame_time[row], keys)) is not None:
                yield found


def _of_row(
    row: int, frame_time: NDArray[np.float64], keys: Sequence[tuple[RowSource, dict[bytes, bytes]]]
) -> KnownRow | None:
    """The row from the first donor that has it, whole."""
    for donor, by_frames in keys:
        key = by_frames.get(frame_time.tobytes())
        if key is not None and (features := donor.take(key)) is not None:
            return KnownRow(row, key, features, donor.environment_of(key))
    return None
