"""Whether the store that these params describe has room: on the disk, in memory, in maps."""

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.base.config import Params
from pipeline.base.durable import free_bytes
from pipeline.base.errors import RecordingError, StoreMismatch, VLMError
from pipeline.base.format import size
from pipeline.data import Recording, open_recordings
from pipeline.data.episode import read_episode
from pipeline.data.timeline import ActionRotation, choose_action_rotation
from pipeline.extract.layout import build_arrays
from pipeline.extract.plan import store_bytes
from pipeline.extract.survey import CheckedEpisode, Survey, SurveyedEpisode
from pipeline.look.doctor.checkpoint import local_folder
from pipeline.look.doctor.data import unusable
from pipeline.look.doctor.findings import Finding, missing, note, ok
from pipeline.look.doctor.links import links_here
from pipeline.store import part_path
from pipeline.store.memory import memory_bytes
from pipeline.vlm.feature_spec import feature_spec

BUDGET_S = 2.0
"""How long episodes are read for the estimate; the rest is taken to be like them."""
MOST_READ = 100


@dataclass(frozen=True)
class Estimate:
    """What a store will take."""

    bytes: int
    maps: int
    """Chunk files, each of which a process maps."""
    episodes: int
    read: int
    """Episodes that were read; the others are taken to be as long."""

    def __str__(self) -> str:
        known = "" if self.read == self.episodes else f", judged by {self.read} of them"
        return f"about {size(self.bytes)} for {self.episodes} episodes{known}"


def check_space(params: Params) -> list[Finding]:
    """The store of `params`, without loading the model or decoding a frame."""
    target = params.extract.store
    if local_folder(params.vlm.checkpoint, params.vlm.revision) is None:
        return [note("size", "not known before vlm.checkpoint is here; see above")]
    try:
        estimate, bad = estimate_store(params)
    except RecordingError:
        return [note("size", "not known before the recordings can be read; see above")]
    except (VLMError, StoreMismatch) as error:
        return [missing("size", f"not known: {error}", "mend that, and run this again")]
    findings: list[Finding] = []
    if bad:
        said = f"{len(bad)} episode(s) read for the size cannot be used, first: {bad[0]}"
        findings.append(unusable("episodes", said, params.data.on_bad_episode))
    if estimate is None:
        return [*findings, note("size", "not known: no episode could be read; see above")]
    begun, finished = used_bytes(part_path(target)), used_bytes(target)
    free = free_bytes(target)
    findings.append(check_disk(estimate, target, free, begun, finished=finished > 0))
    if links_here() == "copy":
        findings.append(check_cached_copy(estimate, free, begun, finished))
    findings.append(check_page_cache(estimate, memory_bytes()))
    limit = Path("/proc/sys/vm/max_map_count")
    if limit.exists():
        findings.append(check_maps(estimate, int(limit.read_text(encoding="ascii"))))
    return findings


def check_disk(
    estimate: Estimate, target: Path, free: int, begun: int, *, finished: bool
) -> Finding:
    """Room for the store, less what an unfinished build of it has already."""
    said = f"{estimate}; {size(free)} free in {target.parent}"
    if begun:
        said += f", {size(begun)} of it written by an unfinished build"
    if estimate.bytes - begun <= free:
        return ok("disk", f"{said}; {target} is finished" if finished else said)
    remedy = (
        "make room, set extract.store to another disk, extract.dtype to float16, or fewer "
        "vlm.pooling slots"
    )
    if finished:
        return note("disk", f"{said}; {target} is there, but another has no room beside it", remedy)
    return missing("disk", said, remedy)


def check_cached_copy(estimate: Estimate, free: int, begun: int, finished: int) -> Finding:
    """Room for the second store that DVC keeps where it can only copy, less what is written."""
    written = min(finished or begun, estimate.bytes)
    said = f"DVC can only copy into its cache: {size(2 * estimate.bytes)} with its copy"
    if written:
        said += f", {size(written)} of it written"
    if finished:
        said += ", and the copy too if DVC has seen this store"
    if 2 * estimate.bytes - written <= free:
        return ok("DVC's copy", said)
    remedy = "put .dvc/cache on the same disk (dvc cache dir), or call the stages without DVC"
    return note("DVC's copy", said, remedy)


def check_page_cache(estimate: Estimate, memory: int) -> Finding:
    """Whether training reads the store at memory speed after its first epoch."""
    if estimate.bytes <= 0.7 * memory:
        return ok("page cache", f"the store fits into memory ({size(memory)})")
    said = f"the store is larger than what {size(memory)} of memory keeps, so it is read from disk"
    remedy = "keep it on a local NVMe disk, or set extract.dtype to float16"
    return note("page cache", said, remedy)


def check_maps(estimate: Estimate, limit: int) -> Finding:
    """Room among the maps of a process."""
    said = f"{estimate.maps} chunk files; vm.max_map_count is {limit}"
    if estimate.maps < 0.8 * limit:
        return ok("maps", said)
    return missing("maps", said, f"sudo sysctl vm.max_map_count={4 * max(estimate.maps, limit)}")


def estimate_store(params: Params) -> tuple[Estimate | None, list[str]]:
    """What `extract.plan=true` computes, from a few episodes within `BUDGET_S`.

    And why some of these cannot be used; they count as left out. None where that is all of them.
    Raises `RecordingError` where a source cannot be opened, `VLMError` where the checkpoint
    does not fit the params, `StoreMismatch` where two sources are not of one embodiment.
    """
    opened = open_recordings(params.data.sources, params.data.root, params.data.views)
    rotation = choose_action_rotation(params.data.action_rotation, opened.recordings)
    checked: list[CheckedEpisode] = []
    bad: list[str] = []
    until = time.monotonic() + BUDGET_S
    for recording in _spread(opened.recordings)[:MOST_READ]:
        if (checked or bad) and time.monotonic() > until:
            break
        try:
            checked.append(_read(recording, params, rotation))
        except RecordingError as error:
            bad.append(str(error))
    if not checked:
        return None, bad
    views = sorted({view for one in checked for view in one.surveyed.recording.view_names()})
    # A digest decides nothing of a size, and reading every weight for it takes long.
    spec = feature_spec(params.vlm, params.extract.dtype, views, lambda path: "")
    survey = Survey(params, tuple(one.surveyed for one in checked), (), (), spec, rotation, "")
    episodes = len(opened.recordings) - len(bad)
    times = episodes / len(checked)
    specs = {
        name: replace(one, shape=(math.ceil(one.shape[0] * times), *one.shape[1:]))
        for name, one in build_arrays(checked, survey).items()
    }
    maps = sum(one.chunk_count for one in specs.values())
    return Estimate(store_bytes(specs), maps, episodes, len(checked)), bad


def used_bytes(folder: Path) -> int:
    """Bytes on the disk of the files below a folder; 0 where there is none."""
    files = (Path(root, name) for root, _, names in os.walk(folder) for name in names)
    return sum(file.lstat().st_blocks * 512 for file in files)


def _spread(recordings: Sequence[Recording]) -> list[Recording]:
    """All of them, in an order whose every beginning comes from all over: the golden ratio's."""
    order = sorted(range(len(recordings)), key=lambda at: at * 0.6180339887498949 % 1)
    return [recordings[at] for at in order]


def _read(recording: Recording, params: Params, rotation: ActionRotation) -> CheckedEpisode:
    _ = recording.instruction  # some formats read it when asked; remembered
    read = read_episode(recording, params.data.action_hz, params.data.vlm_reuse_count, rotation)
    return CheckedEpisode.of(SurveyedEpisode(recording, "", ""), read)
