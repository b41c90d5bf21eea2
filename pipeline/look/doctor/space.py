"""Whether the store that these params describe has room: on the disk and in memory."""

import math
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.base.config import DataParams, Params
from pipeline.base.durable import free_bytes
from pipeline.base.errors import RecordingError
from pipeline.base.format import size
from pipeline.base.issue import Issue
from pipeline.base.memory import memory_bytes
from pipeline.data import Recording, open_recordings
from pipeline.data.episode import read_episode
from pipeline.data.timeline import choose_action_rotation
from pipeline.extract.layout import build_arrays
from pipeline.extract.plan import store_bytes
from pipeline.extract.survey import CheckedEpisode, Survey
from pipeline.look.doctor import missing, note, ok
from pipeline.look.doctor.checkpoint import local_folder
from pipeline.look.doctor.data import unusable
from pipeline.store import part_path
from pipeline.vlm.feature_spec import feature_spec

BUDGET_S = 2.0
"""How long episodes are read for the estimate; the rest is taken to be like them."""
MOST_READ = 100


def check(params: Params) -> Iterator[Issue]:
    """The store of `params`, without loading the model or decoding a frame."""
    data, target = params.data, params.extract.store
    if local_folder(params.vlm.checkpoint, params.vlm.revision) is None:
        yield note("size", "not known before vlm.checkpoint is here; see above")
        return
    try:
        recordings = open_recordings(data.sources, data.root, data.views).recordings
    except RecordingError:
        recordings = ()
    read, bad = measure(recordings, data)
    if bad:
        text = f"{len(bad)} episode(s) read for the size cannot be used, first: {bad[0]}"
        yield unusable("episodes", text, data.on_bad_episode)
    if not read:
        yield note("size", "not known: no episode could be read; see above")
        return
    episodes = len(recordings) - len(bad)
    taken = estimated_bytes(read, episodes, params)
    estimate = f"about {size(taken)} for {episodes} episodes"
    if len(read) < episodes:
        estimate += f", judged by {len(read)} of them"
    yield check_disk(taken, estimate, target, free_bytes(target), used_bytes(part_path(target)))
    yield check_page_cache(taken, memory_bytes())


def check_disk(taken: int, estimate: str, target: Path, free: int, begun: int) -> Issue:
    """Room for the store, less what an unfinished build of it has already."""
    text = f"{estimate}; {size(free)} free in {target.parent}"
    if begun:
        text += f", {size(begun)} of it written by an unfinished build"
    if target.exists():
        text += f"; {target} is finished"
    if taken - begun <= free:
        return ok("disk", text)
    remedy = "make room, set extract.store to another disk, or extract.dtype to float16"
    return (note if target.exists() else missing)("disk", text, remedy)


def check_page_cache(taken: int, memory: int) -> Issue:
    """Whether training reads the store at memory speed after its first epoch."""
    if taken <= 0.7 * memory:
        return ok("page cache", f"the store fits into memory ({size(memory)})")
    text = f"the store is larger than what {size(memory)} of memory keeps, so it is read from disk"
    return note("page cache", text, "keep it on a local NVMe disk, or use extract.dtype float16")


def measure(
    recordings: Sequence[Recording], data: DataParams
) -> tuple[list[CheckedEpisode], list[str]]:
    """A few episodes, read within `BUDGET_S`, and why others of them cannot be used."""
    rotation = choose_action_rotation(data.action_rotation, recordings)
    # An order whose every beginning comes from all over: the golden ratio's.
    order = sorted(range(len(recordings)), key=lambda at: at * 0.6180339887498949 % 1)
    read: list[CheckedEpisode] = []
    bad: list[str] = []
    until = time.monotonic() + BUDGET_S
    for recording in (recordings[at] for at in order[:MOST_READ]):
        if (read or bad) and time.monotonic() > until:
            break
        try:
            episode = read_episode(recording, data.action_hz, data.vlm_reuse_count, rotation)
        except RecordingError as error:
            bad.append(str(error))
            continue
        rows = (episode.timeline, episode.readings, episode.states)
        read.append(CheckedEpisode(*rows, recording.source, {}, recording, episode.embodiment))
    return read, bad


def estimated_bytes(read: Sequence[CheckedEpisode], episodes: int, params: Params) -> int:
    """About what `extract.plan=true` computes, where all episodes are like those read.

    Raises `VLMError` where the checkpoint does not fit the params, and `StoreMismatch` where two
    sources are not of one embodiment.
    """
    views = {view for episode in read for view in episode.ticks.frames}
    # A digest decides nothing of a size, and reading every weight for it takes long.
    spec = feature_spec(params.vlm, params.extract.dtype, sorted(views), lambda path: "")
    surveyed = Survey(params, (), (), (), spec, "rotvec", plan="")
    return math.ceil(store_bytes(build_arrays(read, surveyed)) * episodes / len(read))


def used_bytes(folder: Path) -> int:
    """Bytes on the disk of the files below a folder; 0 where there is none."""
    files = (Path(root, name) for root, _, names in os.walk(folder) for name in names)
    return sum(file.lstat().st_blocks * 512 for file in files)
