"""Check a whole store: structure, files, the checksum of every row, NaN, and what arrays agree on.

Every byte is read once, a chunk file at a time in blocks of a few megabytes, by several threads or
by dask workers on hosts that see the store.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import numpy as np
import zarr
from dask.threaded import get as run_in_threads
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.store.archive import is_archive
from pipeline.store.integrity.findings import MOST_LINES, Damage, Findings, Places, runs_of
from pipeline.store.integrity.invariants import EpisodeTable, RelationTask, relation_tasks
from pipeline.store.integrity.scan import CHANGED, UNREADABLE, UNWRITTEN, ChunkReport, ChunkTask
from pipeline.store.integrity.structure import (
    GROUPS,
    NO_DIGEST,
    check_attributes,
    check_digest,
    read_arrays,
    strange_files,
)
from pipeline.store.metadata import ATTRIBUTE
from pipeline.store.repair_hints import extract_command, restore_command
from pipeline.store.replacement import inode_of, refuse_replaced
from pipeline.store.schema import CHECKSUMS, FEATURES, ArraySpec, chunk_paths

Report = TypeVar("Report", covariant=True)


def verify(path: Path, threads: int, workers: int | str = 0) -> Findings:
    """Everything that is wrong with a finished store, which is only read.

    `workers` is 0 for `threads` of this process, a number of local dask processes, or the address
    of a scheduler whose workers see the store under the same path. Raises `StoreIncomplete` where
    there is no finished store, `StoreMismatch` where it is an archive, or was replaced meanwhile,
    `ConfigError` where no scheduler answers at the address.
    """
    begun = time.monotonic()
    _refuse_other_things(path)
    inode = inode_of(path)
    specs, damaged = read_arrays(path)
    attrs, unreadable = _attributes(path)
    damaged += unreadable or check_attributes(path, attrs, specs)
    damaged += [] if damaged else check_digest(path)
    notes = () if damaged or ATTRIBUTE in attrs else (NO_DIGEST,)
    tasks = _chunk_tasks(path, specs)
    reports = list(run_tasks(tasks, threads, workers, "verify"))
    if workers:
        _refuse_blind_workers(path, tasks, reports)
    unsound = {task.array for task, report in zip(tasks, reports, strict=True) if report.damage}
    places, relations = Places({}, (), 1), list[Damage]()
    if not any(one.array == "" for one in damaged):
        table = EpisodeTable(path, specs, attrs, unsound)
        reuse, places = int(attrs["vlm_reuse_count"]), table.places
        relations += table.damaged()
        blocks = relation_tasks(path, specs, table, reuse, unsound)
        relations += _relations(path, blocks, run_tasks(blocks, threads, workers, "agree"), places)
    for task, report in zip(tasks, reports, strict=True):
        damaged += _file_damage(task, report, places)
    problems = tuple(strange_files(path, specs))
    refuse_replaced(path, inode)
    return Findings(
        store=path,
        inode=inode,
        rows=sum(report.rows for report in reports if report.array == FEATURES),
        row_bytes=sum(report.rows * specs[report.array].row_bytes for report in reports),
        bytes=sum(report.bytes for report in reports),
        seconds=time.monotonic() - begun,
        damaged=tuple(damaged + relations),
        problems=problems,
        faults=_row_faults(specs, reports),
        places=places,
        notes=notes,
        plan=isinstance(attrs.get("plan"), str),
    )


class Task(Protocol[Report]):
    """A piece of work that can be sent to another process."""

    @property
    def bytes(self) -> int:
        """That it reads, for the progress bar."""
        ...

    def __call__(self) -> Report: ...


def run_tasks(
    tasks: Sequence[Task[Report]], threads: int, workers: int | str, label: str
) -> Iterator[Report]:
    """What each task gives, in order; with a progress bar in bytes."""
    total = sum(task.bytes for task in tasks)
    with tqdm(total=total, desc=label, unit="B", unit_scale=True, disable=None) as progress:
        if workers:
            yield from _on_cluster(tasks, workers, progress)
            return

        def run(task: Task[Report]) -> Report:
            report = task()
            progress.update(task.bytes)
            return report

        graph = {index: (run, task) for index, task in enumerate(tasks)}
        yield from cast("Sequence[Report]", run_in_threads(graph, list(graph), num_workers=threads))


def _on_cluster(
    tasks: Sequence[Task[Report]], workers: int | str, progress: "tqdm[Any]"
) -> Iterator[Report]:
    from distributed import Client, as_completed

    from pipeline.base.scheduler import client_of, private_cluster, quiet

    with ExitStack() as stack:
        stack.enter_context(quiet())
        if isinstance(workers, str):
            client = stack.enter_context(client_of(workers, "verify.workers"))
        else:
            # Of one thread each: checksums hold the interpreter's lock.
            cluster = stack.enter_context(private_cluster(workers, threads=1))
            client = stack.enter_context(Client(cluster, set_as_default=False))
        futures = client.map(_call, tasks, pure=False)
        sizes = {future.key: task.bytes for future, task in zip(futures, tasks, strict=True)}
        for future in as_completed(futures, loop=client.loop):
            progress.update(sizes[future.key])
        yield from cast("list[Report]", client.gather(futures))


def _refuse_blind_workers(
    path: Path, tasks: Sequence[ChunkTask], reports: Sequence[ChunkReport]
) -> None:
    """A file that is here and not there is no damage."""
    pairs = zip(tasks, reports, strict=True)
    if any(report.bytes == 0 and task.path.exists() for task, report in pairs):
        raise StoreIncomplete(
            f"{path}: expected the workers to see the store under this path, they find no file. "
            "Put it on a file system that they share, or set verify.workers=0."
        )


def _call(task: Task[Report]) -> Report:
    return task()


def _refuse_other_things(path: Path) -> None:
    part = path.with_name(path.name + ".part")
    if path.suffix == ".part" and path.exists():
        command = extract_command(path.with_suffix(""))
        raise StoreIncomplete(f"{path}: an unfinished build. Run {command}, then verify.")
    if not path.is_dir():
        found = f"only the unfinished build {part}" if part.exists() else "nothing there"
        raise StoreIncomplete(f"{path}: no finished store ({found}). Run {extract_command(path)}.")
    if not any((path / place / "zarr.json").exists() for place in ("", *GROUPS)):
        raise StoreIncomplete(
            f"{path}: no store (no zarr.json in it). Name one with --set verify.store=…"
        )
    if is_archive(path):
        raise StoreMismatch(
            f"{path}: expected a store, found an archive of one, whose chunks carry checksums of "
            f"their own. Restore it: {restore_command(path)}"
        )


def _attributes(path: Path) -> tuple[dict[str, Any], list[Damage]]:
    try:
        return zarr.open_group(path, mode="r").attrs.asdict(), []
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        what = f"not a zarr group's metadata ({error})"
        return {}, [Damage("", None, path / "zarr.json", what)]


def _chunk_tasks(path: Path, specs: Mapping[str, ArraySpec]) -> list[ChunkTask]:
    """One for each chunk file; of features, where what is needed to judge a row is there."""
    judge = {name: specs[name] for name in (FEATURES, CHECKSUMS, "vl/slot_valid") if name in specs}
    return [
        ChunkTask(path, judge if name == FEATURES else {name: spec}, name, chunk, file)
        for name, spec in specs.items()
        if name != FEATURES or len(judge) == 3
        for chunk, file in enumerate(chunk_paths(path, spec))
    ]


def _row_faults(
    specs: Mapping[str, ArraySpec], reports: Sequence[ChunkReport]
) -> dict[str, NDArray[np.int64]]:
    """Bad feature rows by what is wrong with them.

    Where a file of features is sound and the file of its checksums is not, the rows are good.
    """
    unsound = [one.chunk for one in reports if one.array == CHECKSUMS and one.damage]
    found: dict[str, list[NDArray[np.int64]]] = {}
    for report in (one for one in reports if one.array == FEATURES):
        for what, rows in report.faults.items():
            if what in (CHANGED, UNWRITTEN) and report.damage is None:
                rows = rows[~np.isin(rows // specs[CHECKSUMS].chunk_rows, unsound)]
            if len(rows):
                found.setdefault(what, []).append(rows)
    return {what: np.concatenate(each) for what, each in found.items()}


def _file_damage(task: ChunkTask, report: ChunkReport, places: Places) -> Iterator[Damage]:
    """What is wrong with a chunk file, and with the rows in it unless they are feature rows."""
    rows = task.specs[task.array].chunk_rows_of(task.chunk)
    kind = task.array.split("/")[0]
    if report.damage:
        span = places.span(kind, rows.start, rows.stop - 1)
        what = f"{report.damage}; rows {span} of {task.array}"
        yield Damage(task.array, task.chunk, task.path, what)
    if task.array == FEATURES:
        return
    for what, bad in report.faults.items():
        if what != UNREADABLE:  # said of the file already
            said = _rows_said(bad, kind, places)
            yield Damage(task.array, task.chunk, task.path, f"{what} in {said}")


def _relations(
    path: Path,
    tasks: Sequence[RelationTask],
    found: Iterator[tuple[str, str, NDArray[np.int64]]],
    places: Places,
) -> Iterator[Damage]:
    for task, (array, what, rows) in zip(tasks, found, strict=True):
        if len(rows):
            said = _rows_said(rows, array.split("/")[0], places)
            chunk = int(rows[0]) // task.spec.chunk_rows
            yield Damage(array, chunk, path / array, f"{what} in {said}")


def _rows_said(rows: NDArray[np.int64], kind: str, places: Places) -> str:
    runs = runs_of(rows)
    named = ", ".join(places.span(kind, first, last) for first, last in runs[:MOST_LINES])
    more = sum(last - first + 1 for first, last in runs[MOST_LINES:])
    return f"{'row' if len(rows) == 1 else 'rows'} {named}" + (f" and {more} more" if more else "")
