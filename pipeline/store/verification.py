"""Check a whole store: metadata, files, the checksum of every row, NaN.

Every byte is read once, a chunk file at a time in blocks of a few megabytes, by several threads or
by dask workers on hosts that see the store.
"""

import os
import time
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from tqdm import tqdm
from zarr.buffer import cpu
from zarr.storage import MemoryStore

from pipeline.base.arrays import non_finite
from pipeline.base.errors import StoreIncomplete
from pipeline.base.files import REPLACED
from pipeline.base.format import capped, size
from pipeline.base.issue import Issue
from pipeline.store.border import StoreAttributes, store_border
from pipeline.store.chunks import (
    UNSEALED,
    Seal,
    find_damage,
    metadata_damage,
    read_chunk,
    read_rows,
    row_checksums,
    sealed_trailer,
)
from pipeline.store.episodes import check_index, check_positions
from pipeline.store.golden import GOLDEN, golden_files, golden_issues
from pipeline.store.paths import (
    KNOWN,
    STORE,
    Inode,
    find_attributes,
    inode_of,
    read_plan,
    refuse_replaced,
)
from pipeline.store.reader import FeatureStore, map_array, place
from pipeline.store.schema import (
    ARRAY_NAMES,
    CHECKSUMS,
    FEATURES,
    GROUPS,
    KEYS,
    POSITIONS,
    STREAMS,
    ArraySpec,
    check_agreement,
    chunk_path,
    chunk_paths,
    disagreements,
    read_spec,
    rows_of,
)

# The state of a feature row; an index into `FAULTS`.
SOUND, UNREADABLE, CHANGED, NOT_FINITE = range(4)
FAULTS = ("", "not in its file", "its bytes do not give its checksum", "NaN or infinity")

_Error = partial(Issue, severity="error")


@dataclass(frozen=True)
class ChunkReport:
    """The state of one chunk file.

    `rows` are the rows of the array in it, without padding; `bytes` is how many were read; `damage`
    says what is wrong with the file as a whole. `faults` has an index into `FAULTS` for each
    feature row, and is empty for other arrays.
    """

    array: str
    path: Path
    rows: range
    bytes: int
    damage: str | None
    faults: NDArray[np.uint8]


@dataclass(frozen=True)
class Verification:
    """What was checked in a store and everything that is wrong with it.

    `inode` is that of the checked store: another may have replaced it since. `rows` counts the
    feature rows that could be read; `bytes` those of chunk files, with padding. `bad_rows` are the
    VL rows whose features cannot be used, ascending. `environments` has the software and hardware
    of ranges of rows, if the store has them.
    """

    store: Path
    inode: Inode | None
    rows: int
    bytes: int
    seconds: float
    issues: tuple[Issue, ...]
    bad_rows: NDArray[np.int64]
    environments: Sequence[Mapping[str, Any]]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.issues

    @property
    def damaged(self) -> list[Issue]:
        """The issues of metadata and chunk files."""
        return [issue for issue in self.issues if issue.kind in ("metadata", "chunk")]

    def damaged_chunks(self, array: str) -> set[int]:
        """The damaged chunks of an array."""
        issues = (issue for issue in self.damaged if issue.stream == array)
        return {issue.chunk for issue in issues if issue.chunk is not None}

    def lines(self) -> list[str]:
        """For people: everything that is wrong; long lists are cut."""
        by_kind: dict[str, list[str]] = {}
        for issue in self.issues:
            line = f"{issue.file}: {issue.message}" if issue.file else issue.message
            by_kind.setdefault(issue.kind, []).append(line)
        return [line for kind, lines in by_kind.items() for line in capped(lines, f"of {kind}")]

    def summary(self) -> str:
        """For people: how much was checked, and how fast."""
        return (
            f"{self.store}: checked {self.rows} feature rows, {size(self.bytes)} of files, in "
            f"{self.seconds:.1f} s ({self.bytes / 1e9 / max(self.seconds, 1e-9):.2f} GB/s)"
        )


def verify(path: Path, threads: int, workers: int | str = 0) -> Verification:
    """Everything that is wrong with a finished store, which is only read.

    `workers` is 0 for `threads` of this process, a number of local dask processes, or the address
    of a scheduler whose workers see the store under the same path. Raises `StoreIncomplete` where
    there is no finished store, or one that lost its plan, `StoreMismatch` where it is an archive or
    was replaced meanwhile, `ConfigError` where no scheduler answers at the address.
    """
    begun, inode = time.monotonic(), inode_of(path)
    attributes = find_attributes(path)
    read_plan(path)  # without a plan, nothing in the store can be kept
    specs, issues = read_arrays(path)
    parsed = None
    try:
        parsed = StoreAttributes.of(path, attributes)
        if not issues and (what := metadata_damage(path)):
            issues.append(_metadata_issue(path, what))
        if parsed.seal is None:
            issues.append(_metadata_issue(path, UNSEALED))
        if not issues:
            check_agreement(path, parsed, specs)
    except StoreIncomplete as error:
        issues.append(_metadata_issue(path, str(error)))
    reports = _check_chunks(path, specs, parsed.seal if parsed else None, threads, workers)
    store = None
    if not issues:
        try:
            store = _index(path, attributes, specs, reports)
        except StoreIncomplete as error:
            issues.append(_metadata_issue(path, str(error)))
    issues += [issue for report in reports for issue in _issues(report, specs[report.array], store)]
    if parsed is not None:
        issues += golden_issues(path, parsed, specs.get(KEYS))
    issues += strange_files(path, specs, golden_files(path, parsed) if parsed else None)
    issues += [*_strange_to_zarr(path, issues)]
    refuse_replaced(path, inode)
    bad_rows = [report.rows.start + np.flatnonzero(report.faults) for report in reports]
    return Verification(
        store=path,
        inode=inode,
        rows=sum(int((report.faults != UNREADABLE).sum()) for report in reports),
        bytes=sum(report.bytes for report in reports),
        seconds=time.monotonic() - begun,
        issues=tuple(issues),
        bad_rows=np.concatenate([np.zeros(0, np.int64), *bad_rows]),
        environments=parsed.raw.get("environment", []) if parsed else [],
    )


def _check_chunks(
    path: Path, specs: Mapping[str, ArraySpec], seal: Seal | None, threads: int, workers: int | str
) -> list[ChunkReport]:
    """A report of every chunk file, in the order of the contract."""
    checks = [
        partial(check_chunk, path, specs, name, chunk, seal)
        for name, spec in specs.items()
        for chunk in range(spec.chunk_count)
    ]
    total = sum(spec.chunk_count * spec.chunk_bytes for spec in specs.values())
    reports: list[ChunkReport] = []
    with (
        tqdm(total=total, desc="verify", unit="B", unit_scale=True, disable=None) as bar,
        closing(_run_on_cluster(checks, workers) if workers else _run(checks, threads)) as running,
    ):
        for report in running:
            bar.update(report.bytes)
            reports.append(report)
    if workers and any(report.bytes == 0 and report.path.exists() for report in reports):
        raise StoreIncomplete(  # a file only this host sees is not damaged
            f"{path}: expected the workers to see the store under this path, they find no file. "
            "Put it on a file system that they share, or set verify.workers=0."
        )
    return sorted(reports, key=lambda report: (ARRAY_NAMES.index(report.array), report.rows.start))


def _index(
    path: Path,
    attributes: Mapping[str, Any],
    specs: Mapping[str, ArraySpec],
    reports: Sequence[ChunkReport],
) -> FeatureStore | None:
    """A store with only the episodes, clocks and positions, to name rows in messages; None where
    these are damaged. Raises `StoreIncomplete` where they do not fit each other."""
    names = {name for name in specs if name.startswith("episode/") or name.endswith("/time")}
    names |= POSITIONS.keys()
    if any(report.damage for report in reports if report.array in names):
        return None
    maps = {name: map_array(path, specs[name]) for name in names}
    check_index(path, maps, rows_of(specs))
    check_positions(path, maps)
    store = FeatureStore(path, attributes, maps)
    _ = store.episodes
    return store


def read_arrays(root: Path) -> tuple[dict[str, ArraySpec], list[Issue]]:
    """The arrays with sound metadata, and an issue for each of the others."""
    specs: dict[str, ArraySpec] = {}
    issues: list[Issue] = []
    for name in ARRAY_NAMES:
        try:
            specs[name] = read_spec(root, name)
        except StoreIncomplete as error:
            issues.append(_metadata_issue(root, str(error), name))
    for name, what in [*disagreements(specs)]:
        issues.append(_metadata_issue(root, what, name))
        del specs[name]
    return specs, issues


def check_chunk(
    root: Path, specs: Mapping[str, ArraySpec], array: str, chunk: int, seal: Seal | None = None
) -> ChunkReport:
    """Read a chunk file once, in blocks; runs in any process that sees the store."""
    spec, path = specs[array], chunk_path(root, specs[array], chunk)
    rows = spec.chunk_rows_of(chunk)
    faults = np.full(len(rows) if array == FEATURES else 0, UNREADABLE, np.uint8)

    def judge(first: int, block: NDArray[Any]) -> None:
        values = block[: max(0, len(rows) - first)]  # the rest is padding
        if array == FEATURES and len(values):
            judged = _judge_rows(root, specs, rows.start + first, values)
            faults[first : first + len(values)] = judged

    file = read_chunk(path, spec, judge, sealed_trailer(seal, array, chunk))
    if array == FEATURES and (
        CHECKSUMS not in specs or find_damage(root, [specs[CHECKSUMS]], seal)
    ):  # without checksums, rows are as sound as their file
        faults[np.isin(faults, (SOUND, CHANGED))] = CHANGED if file.damage else SOUND
    return ChunkReport(array, path, rows, file.bytes, file.damage, faults)


def _judge_rows(
    root: Path, specs: Mapping[str, ArraySpec], start: int, features: NDArray[Any]
) -> NDArray[np.int64]:
    """The faults (row,) of feature rows (row, slot, dim) from `start`, indices into `FAULTS`.

    A NaN in an invalid slot is no fault. Where checksums cannot be read, no row counts as
    unchanged; where the validity cannot be read, every slot counts as valid.
    """
    stop = start + len(features)
    try:
        checksums = read_rows(root, specs[CHECKSUMS], start, stop)
    except (KeyError, StoreIncomplete):
        checksums = np.ones(len(features), np.uint32)
    try:
        valid = read_rows(root, specs["vl/slot_valid"], start, stop)
    except (KeyError, StoreIncomplete):
        valid = np.ones(features.shape[:2], np.uint8)
    broken = (non_finite(features).any(axis=2) & (valid != 0)).any(axis=1)
    changed = checksums != row_checksums(features)
    return np.select([broken, changed], [NOT_FINITE, CHANGED], default=SOUND)


def strange_files(
    root: Path, specs: Mapping[str, ArraySpec], golden: Collection[Path] | None
) -> Iterator[Issue]:
    """Files that have no place in a store; `golden` are the files of its golden rows, None where
    they are not known."""
    expected = {*(golden or ())} | {
        root / place / "zarr.json" for place in ("", *GROUPS, *ARRAY_NAMES)
    }
    expected |= {path for spec in specs.values() for path in chunk_paths(root, spec)}
    unjudged = {*ARRAY_NAMES} - {*specs} | ({GOLDEN} if golden is None else set[str]())
    # The next extraction removes these leftovers of a stopped replacement.
    unjudged |= {name for name in (REPLACED, KNOWN) if STORE.owns(root / name)}
    prefixes = tuple(f"{root / name}/" for name in unjudged)
    files = (Path(folder) / file for folder, _, names in os.walk(root) for file in names)
    for path in sorted(files):
        if path not in expected and not str(path).startswith(prefixes):
            what = "has no place in a store, look at it and remove it"
            yield _Error(kind="strange file", message=what, file=path)


def _strange_to_zarr(root: Path, issues: Sequence[Issue]) -> Iterator[Issue]:
    """Documents that zarr itself cannot open and that no issue names yet.

    Each is opened alone in a group in memory, because zarr would wait for a neighbour that is a
    pipe.
    """
    reported = " ".join(f"{issue.file} {issue.message}" for issue in issues)
    border = store_border(root)
    documents = (
        Path(folder, "zarr.json") for folder, _, names in os.walk(root) if "zarr.json" in names
    )
    for document in sorted(path for path in documents if str(path) not in reported):
        try:
            raw = cpu.Buffer.from_bytes(border.read_bytes(document))
            with border.foreign(document, "zarr cannot open it"):
                node = zarr.open_group(MemoryStore({"its/zarr.json": raw}), mode="a")["its"]
                _ = isinstance(node, zarr.Group) and [*node.members()]  # that its own metadata list
        except StoreIncomplete as error:
            yield _metadata_issue(root, str(error))


def _metadata_issue(root: Path, what: str, array: str = "") -> Issue:
    file = root / array / "zarr.json"
    message = what.removeprefix(f"{file}: ")
    return _Error(kind="metadata", message=message, stream=array, file=file)


def _run(checks: Sequence[Callable[[], ChunkReport]], threads: int) -> Generator[ChunkReport]:
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(lambda check: check(), checks)


def _run_on_cluster(
    checks: Sequence[Callable[[], ChunkReport]], workers: int | str
) -> Generator[ChunkReport]:
    from distributed import Client, as_completed

    from pipeline.base.scheduler import client_of, private_cluster, quiet

    with ExitStack() as stack:
        stack.enter_context(quiet())
        if isinstance(workers, str):
            client = stack.enter_context(client_of(workers, "verify.workers"))
        else:
            # One thread per process: checksums hold the interpreter's lock.
            cluster = stack.enter_context(private_cluster(workers, threads=1))
            client = stack.enter_context(Client(cluster, set_as_default=False))
        futures = [client.submit(check, pure=False) for check in checks]
        for _, report in as_completed(futures, loop=client.loop, with_results=True):
            yield cast("ChunkReport", report)


def _issues(report: ChunkReport, spec: ArraySpec, store: FeatureStore | None) -> Iterator[Issue]:
    """The damage of a chunk file, and each run of feature rows with the same fault."""
    rows, stream = report.rows, report.array.partition("/")[0]
    if report.damage:
        where = f"rows {rows.start} to {rows.stop - 1} of {spec.name}{_name(store, stream, rows)}"
        what, chunk = f"{report.damage}; {where}", rows.start // spec.chunk_rows
        yield _Error(kind="chunk", message=what, stream=spec.name, file=report.path, chunk=chunk)
    for run in np.split(np.arange(len(report.faults)), np.flatnonzero(np.diff(report.faults)) + 1):
        if len(run) and (fault := report.faults[run[0]]):
            bad = rows[run[0] : run[-1] + 1]
            words = f"row {bad[0]}" if len(bad) == 1 else f"rows {bad[0]} to {bad[-1]}"
            message = f"VL {words}: {FAULTS[fault]}{_name(store, 'vl', bad)}"
            yield _Error(kind="feature rows", message=message, stream=FEATURES)


def _name(store: FeatureStore | None, stream: str, rows: range) -> str:
    """The episodes of the first and last of these rows."""
    if store is None or stream not in STREAMS:
        return ""
    ends = dict.fromkeys((rows[0], rows[-1]))
    return "; " + " to ".join(place(store, stream, row) for row in ends)
