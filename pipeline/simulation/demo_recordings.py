"""The demo's recordings: simulated episodes in every format that can be read, in one folder.

    raw/<task>/data_collection_…   new/<task>/episode_…   old/<task>/recv_all_…   lerobot/

`demo.json` names the seed and version that wrote them, and their digest. A demo appears whole or
not at all; a finished one is kept, one of other params is replaced, and one to which somebody else
added files is refused.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from pipeline.base import files
from pipeline.base.digests import joint_digest
from pipeline.base.documents import Border, Document, Text
from pipeline.base.errors import ConfigError
from pipeline.base.files import OutputKind, recover_folder, replace_folder, write_document
from pipeline.simulation.insertion_formats import (
    ABUTTING,
    OVERLAPPING,
    write_lerobot,
    write_new,
    write_old,
    write_raw,
)
from pipeline.simulation.recorder import Demonstration, simulate_episode

DEMO_VERSION: Final = 2
"""Raise it whenever the same seed gives other recordings."""
MARKER: Final = "demo.json"
_MARKERS: Final = {MARKER, files.MARKER}
DEMO: Final = OutputKind("a demo", lambda folder: (folder / MARKER).is_file())
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
    digest: Text = ""
    """`contents_digest` of the folder when it was written."""


Episodes = Iterator[Demonstration]
Write = Callable[[Path, Episodes], None]


def write_demo_recordings(root: Path, episodes: int, seed: int) -> None:
    """Write `episodes` simulated episodes in each of the four formats to `root`.

    The same arguments give the same bytes, and a folder that they wrote is kept. Raises as
    `replace_demo`.
    """
    wanted = {"version": DEMO_VERSION, "episodes": episodes, "seed": seed}
    recover_folder(root, DEMO)
    if (root / MARKER).exists() and all((root / name).is_dir() for name in _SETS):
        marked = BORDER.read_json(root / MARKER, _Marker)
        if marked.model_dump(include={*wanted}) == wanted:
            return
    write = partial(_write_sets, episodes=episodes, seed=seed)
    replace_demo(root, wanted, write)


def replace_demo(folder: Path, wanted: Mapping[str, int], write: Callable[[Path], None]) -> None:
    """Replace a folder of the demo by what `write` writes, marked with `wanted`.

    Raises `ConfigError` where `folder` holds something that the demo did not write, `DiskFull`
    where the disk is full.
    """
    recover_folder(folder, DEMO)
    if (folder / MARKER).exists():
        marked = BORDER.read_json(folder / MARKER, _Marker)
        if contents_digest(folder) != marked.digest:
            raise ConfigError(
                f"{folder}: expected the files that the demo wrote, found others or changed ones. "
                "It was left as it is: move it away, or remove it"
            )

    def write_marked(place: Path) -> None:
        write(place)
        write_document(place / MARKER, {**wanted, "digest": contents_digest(place)})

    replace_folder(folder, write_marked, DEMO)


def contents_digest(folder: Path) -> str:
    """Digest of names and sizes of the files below a folder, markers left out."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in _MARKERS)
    named = (f"{path.relative_to(folder)} {path.stat().st_size}" for path in files)
    return joint_digest(*sorted(named))


def _write_sets(root: Path, episodes: int, seed: int) -> None:
    """Write the sets, with a thread for each core.

    Threads are enough: compressing and drawing, which take most of the time, run in parallel.
    """
    stop, total = Event(), len(_SETS) * episodes
    with (
        tqdm(None, "simulating", total, unit="episode", disable=None) as progress,
        ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool,
    ):
        # The last takes longest: begun first, it does not end alone.
        writing = [
            pool.submit(write, root / name, _simulated(number, episodes, seed, progress, stop))
            for number, (name, write) in reversed([*enumerate(_SETS.items())])
        ]
        try:
            for written in as_completed(writing):
                written.result()
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
    write: Callable[[Path, Demonstration], None], folder: Path, episodes: Episodes
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
