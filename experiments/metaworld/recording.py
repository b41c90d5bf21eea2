"""Scripted demonstrations of Meta-World's tasks: one LeRobot v3.0 set a task.

    OUT/assembly-v3, …    the set, and record.json: its seeds, and those that the expert failed

A row is a control step, 80 a second: the state and the frame before it, and the action that the
scripted expert then took. Only episodes that end in success are kept. A set is the same, whatever
number of processes made it.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.documents import Border, Document
from pipeline.base.errors import ConfigError
from pipeline.base.files import OutputKind, replace_folder, there, write_document
from pipeline.data.lerobot_writer import LeRobotRows, write_data_set
from pipeline.simulation.meta_world import (
    ACTION,
    HZ,
    STATE,
    VIEW,
    MetaWorldEnvironment,
    instruction_of,
)

Purpose = Literal["demonstrations", "validation", "evaluation"]
_FIRST: Final[dict[Purpose, int]] = {
    "demonstrations": 0,
    "validation": 1_000_000,
    "evaluation": 2_000_000,
}
SEEDS: Final = 10_000
"""Episodes of a purpose for each number of a run; runs are numbered from 0 to 99."""
_TRIED: Final = 4
"""Seeds that are tried for each demonstration wanted, at most."""
RECORD: Final = "record.json"
VERSION: Final = 2
"""Of the recorder; a set of another is refused. 1 had lossy films and wrong first frames."""
_SET: Final = OutputKind("a set of demonstrations", lambda folder: (folder / RECORD).is_file())
_BORDER: Final = Border(ConfigError, "Remove the folder that it is in and record again.")


class Record(Document):
    """The content of `record.json`."""

    version: int = 1
    """The `VERSION` that recorded it."""
    task: str
    run: int
    episodes: int
    image: int = 224
    """Height and width of its frames."""
    shadows: bool = False
    noise_mm: float = 0.0
    """Spread of what is added to each motion that is carried out, not to the one that is kept, so
    that demonstrations show how to come back (Laskey et al. 2017, "DART")."""
    seeds: tuple[int, ...] = ()
    failed: tuple[int, ...] = ()
    """Seeds whose episodes the expert failed; they are not in the set."""

    @property
    def wanted(self) -> dict[str, Any]:
        """What it was asked for, without what came out."""
        return self.model_dump(exclude={"seeds", "failed"})


def seeds_of(purpose: Purpose, run: int) -> range:
    """Seeds of episodes: those of two purposes, or of two runs, have none in common.

    Raises `ConfigError` for a run that is not from 0 to 99.
    """
    if not 0 <= run < 100:
        raise ConfigError(f"seed: expected a number from 0 to 99, found {run}")
    first = _FIRST[purpose] + run * SEEDS
    return range(first, first + SEEDS)


def record(out: Path, wanted: Sequence[Record], jobs: int) -> list[Record]:
    """Write the sets that are not there yet; returns the records of all.

    Raises `ConfigError` where a set is there that was recorded otherwise, and where the expert
    fails so often that too few seeds are left.
    """
    missing = [one for one in wanted if _finished(out, one) is None]
    for one in missing:
        # An unknown task is refused before anything is recorded.
        MetaWorldEnvironment(one.task, one.image)
    total = sum(one.episodes for one in wanted)
    done = total - sum(one.episodes for one in missing)
    with (
        tqdm(None, "recording", total, initial=done, unit="episode", disable=None) as progress,
        ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool,
    ):
        for one in missing:
            _record_set(out, one, pool, jobs, progress)
    return [kept for one in wanted if (kept := _finished(out, one)) is not None]


def _record_set(
    out: Path, wanted: Record, pool: ProcessPoolExecutor, jobs: int, progress: "tqdm[Any]"
) -> None:
    from pipeline.extract.engine import in_background  # no process that draws needs torch

    seeds: dict[bool, list[int]] = {True: [], False: []}

    def on_a_core(seed: int) -> tuple[int, LeRobotRows | None]:
        return seed, pool.submit(demonstrate, wanted, seed).result()

    def kept() -> Iterator[LeRobotRows]:
        tried = seeds_of("demonstrations", wanted.run)[: _TRIED * wanted.episodes]
        shown = in_background(tried, on_a_core, jobs)
        with closing(shown):
            for seed, rows in shown:
                seeds[rows is not None].append(seed)
                if rows is not None:
                    yield rows
                    progress.update()
                if len(seeds[True]) == wanted.episodes:
                    return
        raise ConfigError(
            f"{wanted.task}: the scripted expert succeeded in {len(seeds[True])} of "
            f"{len(tried)} episodes, expected {wanted.episodes}; ask for fewer with --episodes"
        )

    def write(folder: Path) -> None:
        units = {"names": list(STATE.names), "units": list(STATE.units)}
        moves = {"names": list(ACTION.names), "units": list(ACTION.units), "kind": "delta"}
        features = {"observation.state": units, "action": moves}
        task = instruction_of(wanted.task)
        # A policy sees frames as they are drawn; features of random weights are sensitive to what a
        # lossy film changes, even where an eye sees no difference.
        write_data_set(folder, kept(), features, task, HZ, "meta_world_sawyer", lossless=True)
        document = wanted.model_dump(mode="json") | {"seeds": seeds[True], "failed": seeds[False]}
        write_document(folder / RECORD, document)

    replace_folder(out / wanted.task, write, _SET)


def demonstrate(wanted: Record, seed: int) -> LeRobotRows | None:
    """One episode of the scripted expert, with a frame of each step; None where it failed."""
    environment = MetaWorldEnvironment(wanted.task, wanted.image, wanted.shadows)
    readings, _ = environment.reset(seed=seed)
    noise = np.random.default_rng(seed)
    states: list[NDArray[np.float32]] = []
    actions: list[NDArray[np.float32]] = []
    frames: list[NDArray[np.uint8]] = []
    while not environment.finished:
        states.append(readings["state"][0])
        actions.append(environment.expert_action())
        frames.append(environment.frames()[VIEW][1])
        pushed = wanted.noise_mm * noise.standard_normal(3)
        readings, *_ = environment.step(actions[-1] + np.append(pushed, 0.0))
    columns = {
        "observation.state": np.stack(states),
        "action": np.stack(actions),
        "timestamp": (np.arange(len(states)) / HZ).astype(np.float32),
    }
    film = {f"observation.images.{VIEW}": np.stack(frames)}
    return LeRobotRows(columns, film) if environment.success else None


def _finished(out: Path, wanted: Record) -> Record | None:
    """The record of a set that is there; None where there is no folder.

    Raises `ConfigError` where what is there was recorded otherwise.
    """
    folder = out / wanted.task
    if not there(folder):
        return None
    kept = _BORDER.read_json(folder / RECORD, Record)
    if kept.wanted != wanted.wanted:
        differ = [f"{k} {v}" for k, v in kept.wanted.items() if wanted.wanted[k] != v]
        raise ConfigError(
            f"{folder / RECORD}: expected a set as asked for now, found one with "
            f"{', '.join(differ)}. Move it away, or record to another folder (--out)"
        )
    return kept
