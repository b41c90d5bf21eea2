"""Whether the store that these params describe has room: on the disk and in memory."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.base.config import DataParams, Params
from pipeline.base.errors import RecordingError
from pipeline.base.files import free_bytes
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

MOST_READ = 10
"""Episodes that are read for the estimate; the rest is taken to be like them."""


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
    yield check_disk(taken, estimate, target, free_bytes(target))
    yield check_page_cache(taken, memory_bytes())


def check_disk(taken: int, estimate: str, target: Path, free: int) -> Issue:
    """Room for the store; where it or a build of it is there already, what is lacking is a note."""
    text = f"{estimate}; {size(free)} free in {target.parent}"
    there = [str(path) for path in (target, part_path(target)) if path.exists()]
    if there:
        text += f"; {there[0]} is there already"
    if taken <= free:
        return ok("disk", text)
    remedy = "make room, set extract.store to another disk, or extract.dtype to float16"
    return (note if there else missing)("disk", text, remedy)


def check_page_cache(taken: int, memory: int) -> Issue:
    """Whether training reads the store at memory speed after its first epoch."""
    if taken <= 0.7 * memory:
        return ok("page cache", f"the store fits into memory ({size(memory)})")
    text = f"the store is larger than what {size(memory)} of memory keeps, so it is read from disk"
    return note("page cache", text, "keep it on a local NVMe disk, or use extract.dtype float16")


def measure(
    recordings: Sequence[Recording], data: DataParams
) -> tuple[list[CheckedEpisode], list[str]]:
    """A few episodes from all over, and why others of them cannot be used."""
    rotation = choose_action_rotation(data.action_rotation, recordings)
    step = math.ceil(len(recordings) / MOST_READ)
    read: list[CheckedEpisode] = []
    bad: list[str] = []
    for recording in recordings[:: max(1, step)]:
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
