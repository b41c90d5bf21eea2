"""Check a whole store: structure, files, the checksum of every row, NaN.

Every byte is read once, a chunk file at a time in blocks of a few megabytes, by several threads or
by dask workers on hosts that see the store. What the arrays say of each other is left to those who
build stores: the trailers prove that they hold what was written.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.errors import StoreIncomplete
from pipeline.base.finite import non_finite
from pipeline.base.format import size
from pipeline.base.issue import Issue
from pipeline.store.chunks import ChunkFiles, read_chunk, read_rows, row_checksums
from pipeline.store.environments import runs_of
from pipeline.store.integrity.structure import (
    check_attributes,
    check_digest,
    read_arrays,
    strange_files,
)
from pipeline.store.metadata import ATTRIBUTE
from pipeline.store.paths import Inode, inode_of, read_attributes, read_plan, refuse_replaced
from pipeline.store.reader import FeatureStore, map_array, place
from pipeline.store.repair_hints import mend
from pipeline.store.schema import CHECKSUMS, FEATURES, STREAMS, ArraySpec, chunk_paths

MOST_LINES = 20
"""Of one kind that are shown; the rest is counted."""
UNREADABLE = "not in its file"
UNWRITTEN = "was never written (its checksum is 0)"
CHANGED = "its bytes do not give its checksum"
NOT_FINITE = "NaN or infinity"
_BESIDE = (CHECKSUMS, "vl/slot_valid")
"""What feature rows are judged by."""
_NO_DIGEST = "an earlier version wrote it without a metadata_digest: attributes cannot be checked"


@dataclass(frozen=True)
class ChunkReport:
    """How one chunk file is."""

    array: str
    chunk: int
    path: Path
    bytes: int
    """That were read."""
    rows: int
    """That could be read, those of padding left out."""
    damage: str | None
    """What is wrong with the file as a file."""
    faults: Mapping[str, NDArray[np.int64]]
    """Feature rows that cannot be used, by what is wrong with them."""


@dataclass(frozen=True)
class Verification:
    """What was checked of a store and everything that is wrong with it."""

    store: Path
    inode: Inode | None
    """Of the store that was checked: another may have taken its place since."""
    rows: int
    """Feature rows that could be read and were checked."""
    row_bytes: int
    """Of the rows of all arrays."""
    bytes: int
    """Of the chunk files that were read, with the padding behind the last rows."""
    seconds: float
    issues: tuple[Issue, ...]
    """Of metadata, chunk files and feature rows, `stream` being the array, and strange files."""
    bad_rows: NDArray[np.int64]
    """The VL rows whose features cannot be used, ascending."""
    notes: tuple[str, ...]
    """What could not be checked."""

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.issues

    @property
    def damaged(self) -> list[Issue]:
        """Those of metadata and chunk files."""
        return [issue for issue in self.issues if issue.kind in ("metadata", "chunk")]

    def damaged_chunks(self, array: str) -> set[int]:
        """Chunks of an array that something is wrong with."""
        issues = (issue for issue in self.damaged if issue.stream == array)
        return {issue.chunk for issue in issues if issue.chunk is not None}

    def lines(self) -> list[str]:
        """For people: everything that is wrong, long lists capped."""
        by_kind: dict[str, list[str]] = {}
        for issue in self.issues:
            line = f"{issue.file}: {issue.message}" if issue.file else issue.message
            by_kind.setdefault(issue.kind, []).append(line)
        return [line for kind, lines in by_kind.items() for line in capped(lines, f"of {kind}")]

    def advice(self) -> str:
        """For people: what to run next."""
        if all(issue.kind == "strange file" for issue in self.issues):
            return "All that was stored is sound: look at these files and remove them."
        return mend(self.store)

    def summary(self) -> str:
        """For people: how much was checked, how fast."""
        rate = self.bytes / 1e9 / self.seconds if self.seconds else 0.0
        return (
            f"{self.store}: checked {self.rows} feature rows, {size(self.row_bytes)} of "
            f"rows in {size(self.bytes)} of files, in {self.seconds:.1f} s "
            f"({rate:.2f} GB/s)"
        )


def verify(path: Path, threads: int, workers: int | str = 0) -> Verification:
    """Everything that is wrong with a finished store, which is only read.

    `workers` is 0 for `threads` of this process, a number of local dask processes, or the address
    of a scheduler whose workers see the store under the same path. Raises `StoreIncomplete` where
    there is no finished store, or one that no longer says what it is, `StoreMismatch` where it is
    an archive or was replaced meanwhile, `ConfigError` where no scheduler answers at the address.
    """
    begun, inode = time.monotonic(), inode_of(path)
    attributes = read_attributes(path)
    read_plan(path)  # without one, nothing of it can be kept
    specs, issues = read_arrays(path)
    issues += check_attributes(path, attributes)
    issues += [] if issues else check_digest(path)
    notes = () if issues or ATTRIBUTE in attributes else (_NO_DIGEST,)
    checks = [
        partial(check_chunk, path, specs, name, chunk)
        for name, spec in specs.items()
        for chunk in range(spec.chunk_count)
    ]
    total = sum(spec.chunk_count * spec.chunk_bytes for spec in specs.values())
    with tqdm(total=total, desc="verify", unit="B", unit_scale=True, disable=None) as bar:
        reports = list(_run(checks, threads, workers, bar))
    if workers:
        _refuse_blind_workers(path, reports)
    bad = [report for report in reports if report.damage or report.faults]
    store = _naming_store(path, attributes, specs, issues, bad) if bad else None
    for report in bad:
        issues += _chunk_issues(report, specs[report.array], store)
    faults = {
        what: np.concatenate([report.faults[what] for report in bad if what in report.faults])
        for what in dict.fromkeys(what for report in bad for what in report.faults)
    }
    issues += _row_issues(faults, store)
    issues += strange_files(path, specs)
    refuse_replaced(path, inode)
    return Verification(
        store=path,
        inode=inode,
        rows=sum(report.rows for report in reports if report.array == FEATURES),
        row_bytes=sum(report.rows * specs[report.array].row_bytes for report in reports),
        bytes=sum(report.bytes for report in reports),
        seconds=time.monotonic() - begun,
        issues=tuple(issues),
        bad_rows=np.unique(np.concatenate([np.zeros(0, np.int64), *faults.values()])),
        notes=notes,
    )


def judge_rows(
    features: NDArray[Any], checksums: NDArray[np.uint32], slot_valid: NDArray[np.uint8]
) -> dict[str, NDArray[np.bool_]]:
    """Which feature rows (row, slot, dim) cannot be used, (row,) each, by what is wrong.

    `checksums` (row,) and `slot_valid` (row, slot) are as the store holds them: a NaN in a slot
    that is not valid is nobody's.
    """
    broken = non_finite(features).any(axis=2) & (slot_valid != 0)
    changed = checksums != row_checksums(features)
    return {
        NOT_FINITE: broken.any(axis=1),
        UNWRITTEN: checksums == 0,
        CHANGED: changed & (checksums != 0),
    }


def check_chunk(root: Path, specs: Mapping[str, ArraySpec], array: str, chunk: int) -> ChunkReport:
    """Read a chunk file once, in blocks; runs in any process that sees the store."""
    spec, path = specs[array], chunk_paths(root, specs[array])[chunk]
    rows, faults = spec.chunk_rows_of(chunk), defaultdict[str, list[NDArray[np.int64]]](list)

    def judge(first: int, block: NDArray[Any]) -> None:
        start = rows.start + first
        values = block[: max(0, rows.stop - start)]  # the rest is padding
        if len(values):
            beside = (_beside(root, specs, name, start, values) for name in _BESIDE)
            for what, bad in judge_rows(values, *beside).items():
                faults[what].append(start + np.flatnonzero(bad))

    file = read_chunk(path, spec, *([judge] if array == FEATURES else []))
    read = min(file.bytes // spec.row_bytes, len(rows))
    if array == FEATURES:
        faults[UNREADABLE].append(np.arange(rows.start + read, rows.stop))
    joined = {what: np.concatenate(parts) for what, parts in faults.items() if any(map(len, parts))}
    by_checksum = joined.keys() & {CHANGED, UNWRITTEN}
    if by_checksum and not file.damage and _checksums_are_damaged(root, specs, rows):
        joined = {what: bad for what, bad in joined.items() if what not in by_checksum}
    return ChunkReport(array, chunk, path, file.bytes, read, file.damage, joined)


def _beside(
    root: Path, specs: Mapping[str, ArraySpec], name: str, start: int, features: NDArray[Any]
) -> NDArray[Any]:
    """The same rows of another array; ones where that cannot be read, as is said of its file."""
    try:
        return read_rows(root, specs[name], start, start + len(features))
    except (KeyError, StoreIncomplete):
        return np.ones(features.shape[: 1 if name == CHECKSUMS else 2], np.uint8)


def _checksums_are_damaged(root: Path, specs: Mapping[str, ArraySpec], rows: range) -> bool:
    """Whether the checksums of these rows are lost: then those of a sound file are good."""
    if CHECKSUMS not in specs:
        return True
    with closing(ChunkFiles(root, specs[CHECKSUMS], writable=False)) as files:
        chunks = {row // files.spec.chunk_rows for row in (rows.start, rows.stop - 1)}
        return any(files.damage(chunk) for chunk in chunks)


def capped(lines: Sequence[str], kind: str) -> list[str]:
    """The first lines, and how many more there are."""
    more = len(lines) - MOST_LINES
    return [*lines[:MOST_LINES], *([f"and {more} more {kind}"] if more > 0 else [])]


def _run(
    checks: Sequence[Callable[[], ChunkReport]], threads: int, workers: int | str, bar: "tqdm[Any]"
) -> Iterator[ChunkReport]:
    """What each check gives, in order."""
    if workers:
        yield from _run_on_cluster(checks, workers, bar)
        return
    with ThreadPoolExecutor(threads) as pool:
        for report in pool.map(lambda check: check(), checks):
            bar.update(report.bytes)
            yield report


def _run_on_cluster(
    checks: Sequence[Callable[[], ChunkReport]], workers: int | str, bar: "tqdm[Any]"
) -> list[ChunkReport]:
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
        futures = [client.submit(check, pure=False) for check in checks]
        for _, report in as_completed(futures, loop=client.loop, with_results=True):
            bar.update(report.bytes)
        return cast("list[ChunkReport]", client.gather(futures))


def _refuse_blind_workers(path: Path, reports: Sequence[ChunkReport]) -> None:
    """A file that is here and not there is no damage."""
    if any(report.bytes == 0 and report.path.exists() for report in reports):
        raise StoreIncomplete(
            f"{path}: expected the workers to see the store under this path, they find no file. "
            "Put it on a file system that they share, or set verify.workers=0."
        )


def _naming_store(
    path: Path,
    attributes: Mapping[str, Any],
    specs: Mapping[str, ArraySpec],
    issues: Sequence[Issue],
    bad: Sequence[ChunkReport],
) -> FeatureStore | None:
    """The store, as far as rows are named by it; None where that part of it is damaged."""
    needed = [name for name in specs if name.startswith("episode/") or name.endswith("/time")]
    lost = any(report.damage for report in bad if report.array in needed)
    if issues or lost:
        return None
    return FeatureStore(path, attributes, {name: map_array(path, specs[name]) for name in needed})


def _chunk_issues(
    report: ChunkReport, spec: ArraySpec, store: FeatureStore | None
) -> Iterator[Issue]:
    if report.damage:
        rows, stream = spec.chunk_rows_of(report.chunk), report.array.partition("/")[0]
        named = _name(store, stream, rows) if stream in STREAMS else ""
        yield Issue(
            severity="error",
            kind="chunk",
            message=f"{report.damage}; rows {rows.start} to {rows.stop - 1} of {spec.name}{named}",
            stream=report.array,
            file=report.path,
            chunk=report.chunk,
        )


def _row_issues(
    faults: Mapping[str, NDArray[np.int64]], store: FeatureStore | None
) -> Iterator[Issue]:
    """Of each run of feature rows with one fault."""
    for what, bad in faults.items():
        for run in runs_of(bad):
            rows = f"row {run[0]}" if len(run) == 1 else f"rows {run[0]} to {run[-1]}"
            message = f"VL {rows}: {what}{_name(store, 'vl', run)}"
            yield Issue(severity="error", kind="feature rows", message=message, stream=FEATURES)


def _name(store: FeatureStore | None, stream: str, rows: range) -> str:
    """Which rows of which episodes these are."""
    if store is None:
        return ""
    ends = dict.fromkeys((rows[0], rows[-1]))
    return "; " + " to ".join(place(store, stream, row) for row in ends)
