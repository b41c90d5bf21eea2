"""The demo's recordings: simulated episodes in every format that can be read, in one folder.

    raw/<task>/data_collection_…   new/<task>/episode_…   old/<task>/recv_all_…   lerobot/

`demo.json` names the seed and version that wrote the sets, and digests of the sets: finished sets
are kept, sets of other params are replaced, and files that the demo did not write are never
touched.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field
from tqdm import tqdm

from pipeline.base import files
from pipeline.base.border import Border, Document, Text
from pipeline.base.digests import joint_digest
from pipeline.base.errors import ConfigError
from pipeline.base.files import OutputKind, disk_full_named, remove_folder, there, write_document
from pipeline.simulation.insertion_formats import (
    ABUTTING,
    OVERLAPPING,
    write_lerobot,
    write_new,
    write_old,
    write_raw,
)
from pipeline.simulation.recorder import SimulatedEpisode, simulate_episode

DEMO_VERSION: Final = 2
"""Raise it whenever the same seed gives other recordings."""
MARKER: Final = "demo.json"
_MARKERS: Final = {MARKER, files.MARKER}
DEMO: Final = OutputKind("what the demo wrote", lambda folder: (folder / MARKER).is_file())
_SET: Final = OutputKind("a set of the demo's", lambda folder: DEMO.is_one(folder.parent))
TASK: Final = "Insert_the_needle_at_the_red_point"
"""The recorder names its folders after the instruction, which is the same in every format."""

_FIRST_EPOCH_S = datetime(2026, 1, 5, 9, tzinfo=UTC).timestamp()
_BETWEEN_EPISODES_S, _BETWEEN_SETS_S = 45.0, 86_400.0
_OVERLAPPING_EVERY, _ROBOT_CLOCK_EVERY, _CROSSING_EVERY = 6, 3, 6

BORDER: Final = Border(ConfigError, "Remove the folder that it is in and run again.")


class _Marker(Document):
    """The content of `demo.json`."""

    version: int = 0
    episodes: int = 0
    seed: int = 0
    sets: tuple[Literal["raw", "new", "old", "lerobot"], ...] = ()
    contents: dict[Text, Text] = Field(default_factory=dict)
    """`contents_digest` of each set when it was written; "" is the checkpoint beside the marker."""


Episodes = Iterator[SimulatedEpisode]
Write = Callable[[Path, Episodes], None]


def write_demo_recordings(root: Path, episodes: int, seed: int) -> None:
    """Write `episodes` simulated episodes in each of the four formats to `root`.

    Each set appears whole or not at all; a set that is already there stays as it is. The same
    arguments give the same bytes. Raises `ConfigError` where `root` holds something that the demo
    did not write, `DiskFull` where the disk is full.
    """
    wanted = {"version": DEMO_VERSION, "episodes": episodes, "seed": seed}
    finished = _finished_sets(root, wanted)
    with disk_full_named(root):
        root.mkdir(parents=True, exist_ok=True)
        _mark(root, wanted, finished)
        for name in _write_sets(root, finished, episodes, seed):
            (root / f".{name}.part").rename(root / name)
            finished.append(name)
            _mark(root, wanted, finished)


def _write_sets(root: Path, finished: list[str], episodes: int, seed: int) -> Iterator[str]:
    """Write the unfinished sets, with a thread for each core; yields each name when it is written.

    Threads are enough: compressing and drawing, which take most of the time, run in parallel.
    """
    stop = Event()
    missing = {name: number for number, name in enumerate(_SETS) if name not in finished}
    total, done = len(_SETS) * episodes, len(finished) * episodes
    with (
        tqdm(None, "simulating", total, initial=done, unit="episode", disable=None) as progress,
        ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool,
    ):
        writing: dict[Future[None], str] = {}
        try:
            for name, number in missing.items():
                part = root / f".{name}.part"
                remove_folder(part, _SET)
                simulated = _simulated(number, episodes, seed, progress, stop)
                writing[pool.submit(_SETS[name], part, simulated)] = name
            for written in as_completed(writing):
                written.result()
                yield writing[written]
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _simulated(
    number: int, episodes: int, seed: int, progress: "tqdm[Any]", stop: Event
) -> Episodes:
    """The episodes of a set, until `stop` is set."""
    for index in range(episodes):
        if stop.is_set():
            return
        own_seed = int(np.random.SeedSequence([seed, number, index]).generate_state(1)[0])
        fraction = np.random.default_rng(own_seed).uniform(0, 1)
        epoch_s = _FIRST_EPOCH_S + number * _BETWEEN_SETS_S + index * _BETWEEN_EPISODES_S + fraction
        yield simulate_episode(own_seed, epoch_s, index % _CROSSING_EVERY == 2)
        progress.update()


def _write_episodes(
    write: Callable[[Path, SimulatedEpisode], None], folder: Path, episodes: Episodes
) -> None:
    for episode in episodes:
        write(folder / TASK, episode)


def _write_new_set(folder: Path, episodes: Episodes) -> None:
    for index, episode in enumerate(episodes):
        windows = OVERLAPPING if index % _OVERLAPPING_EVERY == 1 else ABUTTING
        write_new(folder / TASK, episode, windows, index % _ROBOT_CLOCK_EVERY == 2)


_SETS: Final[dict[str, Write]] = {
    "raw": partial(_write_episodes, write_raw),
    "new": _write_new_set,
    "old": partial(_write_episodes, write_old),
    "lerobot": write_lerobot,
}


def _finished_sets(root: Path, wanted: dict[str, int]) -> list[str]:
    """The sets that are there as `wanted`; removes the demo's sets of other params."""
    refuse_foreign(root, "demo.recordings")
    path = root / MARKER
    if not path.exists():
        return []
    marked = BORDER.read_json(path, _Marker)
    written = [name for name in marked.sets if (root / name).is_dir()]
    strange = [name for name in _SETS if (root / name).exists() and name not in written]
    if strange:
        raise ConfigError(
            f"{root}: {MARKER} does not list {', '.join(strange)} as the demo's, so it is not "
            "replaced; move it away, or set demo.recordings to another folder"
        )
    if marked.model_dump(include={*wanted}) == wanted:
        return written
    for name in written:
        _refuse_changed(root / name, marked.contents.get(name))
    for name in written:
        remove_folder(root / name, _SET)
    return []


def refuse_changed_checkpoint(folder: Path) -> None:
    """Raise `ConfigError` where a demo's checkpoint holds other files than the demo wrote."""
    if (folder / MARKER).exists():
        _refuse_changed(folder, BORDER.read_json(folder / MARKER, _Marker).contents.get(""))


def _refuse_changed(folder: Path, written: str | None) -> None:
    if contents_digest(folder) != written:
        raise ConfigError(
            f"{folder}: expected the files that the demo wrote, found others or changed ones. It "
            "was left as it is: move it away, or remove it"
        )


def contents_digest(folder: Path) -> str:
    """Digest of names and sizes of the files below a folder, markers left out."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in _MARKERS)
    named = (f"{path.relative_to(folder)} {path.stat().st_size}" for path in files)
    return joint_digest(*sorted(named))


def refuse_foreign(folder: Path, setting: str) -> None:
    """Raise `ConfigError` naming `setting` where `folder` has content that is not the demo's."""
    if there(folder) and not DEMO.owns(folder):
        raise ConfigError(
            f"{folder} is there and has no {MARKER}: the demo did not write it and leaves it "
            f"alone; move it away, or set {setting} to another folder"
        )


def _mark(root: Path, wanted: dict[str, int], finished: list[str]) -> None:
    contents = {name: contents_digest(root / name) for name in finished}
    write_document(root / MARKER, {**wanted, "sets": finished, "contents": contents})
