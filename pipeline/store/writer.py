"""Build a store beside its target, row by row, so that a kill at any instant loses little.

A build is in `<name>.zarr.part`. Data known beforehand (streams, ticks, episodes) are written
first, with their checksums; then feature rows with `pwrite` and `fdatasync`, and only then their
keys and checksums. A row is done when its checksum is not 0. Sealing compares the streams with
their trailers and writes the trailers of the feature rows, so that plain zarr accepts the chunks;
then one rename puts the build in its place.

The software and hardware that computed each feature row are recorded, but are not part of the row's
identity. A build keeps them as one number per row in a separate file, which sealing turns into
ranges of rows in the store's attributes.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.base.errors import StoreIncomplete
from pipeline.base.files import disk_full_named, sync
from pipeline.store.chunks import (
    ChunkFiles,
    check_metadata,
    find_damage,
    note_metadata,
    read_chunk,
    read_rows,
    row_checksums,
    write_seal,
)
from pipeline.store.documents import mend, store_border
from pipeline.store.golden_rows import GoldenFrames, write_golden
from pipeline.store.paths import begin_build, group_attributes, part_path, put_in_place
from pipeline.store.schema import CHECKSUMS, FEATURES, INCREMENTAL, KEYS, ArraySpec, chunk_path

Rows = Sequence[int] | NDArray[np.int64]
"""Store-global VL rows, in any order."""


def environment_at(ranges: Sequence[Mapping[str, Any]], row: int) -> dict[str, Any]:
    """The environment of a row, from the ranges of a store; empty where it is not recorded."""
    noted = next((noted for noted in ranges if row in range(*noted["rows"])), {})
    return {name: value for name, value in noted.items() if name != "rows"}


def environment_runs(
    ranges: Sequence[Mapping[str, Any]], rows: NDArray[np.int64]
) -> Iterator[tuple[dict[str, Any], range]]:
    """Runs of consecutive rows of one environment; `rows` must ascend."""
    edges = np.searchsorted(rows, [edge for noted in ranges for edge in noted["rows"]])
    gaps = np.flatnonzero(np.diff(rows) != 1) + 1
    for run in np.split(rows, np.union1d(edges, gaps).astype(np.int64)):
        if len(run):
            yield environment_at(ranges, int(run[0])), range(int(run[0]), int(run[-1]) + 1)


class EnvironmentLog:
    """The environments of a build's rows, kept beside its arrays until sealing."""

    def __init__(self, part: Path) -> None:
        self._listed = part / ".environments.json"
        self._of_row = part / ".environment_of_row"
        self._temporary = part / ".environments.json.tmp"

    @property
    def noted(self) -> bool:
        """Whether any environment is recorded."""
        return self._listed.exists()

    def index(self, environment: Mapping[str, Any]) -> int:
        """The number of an environment; a new environment gets a new number."""
        known = self._known()
        if environment not in known:
            known.append(dict(environment))
            self._temporary.write_text(json.dumps(known))
            sync(self._temporary)
            self._temporary.replace(self._listed)
        return known.index(dict(environment))

    def note(self, start: int, count: int, number: int) -> None:
        """Record the environment that a run of rows was computed with."""
        descriptor = os.open(self._of_row, os.O_WRONLY | os.O_CREAT, 0o644)
        try:
            os.pwrite(descriptor, np.full(count, number, "<u2").tobytes(), start * 2)
        finally:
            os.close(descriptor)

    def ranges(self) -> list[dict[str, Any]]:
        """`[{"rows": [start, stop], **environment}, ...]`, in order."""
        known, ranges, start = self._known(), [], 0
        numbers = np.fromfile(self._of_row, "<u2") if self._of_row.exists() else np.zeros(0, "<u2")
        for run in np.split(numbers, np.flatnonzero(np.diff(numbers)) + 1):
            if len(run):
                if run[0] >= len(known):
                    what = f"expected the environment of number {run[0]}, found {len(known)}"
                    raise store_border(self._listed.parent).refusal(self._listed, what)
                ranges.append({"rows": [start, start + len(run)], **known[run[0]]})
                start += len(run)
        return ranges

    def remove(self) -> None:
        """Remove the files, the list first, so that a kill in between leaves nothing to read."""
        for path in (self._listed, self._of_row, self._temporary):
            path.unlink(missing_ok=True)

    def _known(self) -> list[dict[str, Any]]:
        known = list[dict[str, Any]]
        border = store_border(self._listed.parent)
        return border.read_json(self._listed, known) if self._listed.exists() else []


class StoreBuild:
    """An unfinished store.

    `plan` identifies what it will hold; only a build of the same plan is continued.
    """

    def __init__(self, target: Path, specs: Mapping[str, ArraySpec], plan: str) -> None:
        self.target = target
        self.part = part_path(target)
        self.specs = dict(specs)
        self.plan = plan
        self._files: dict[str, ChunkFiles] = {}
        self._environments = EnvironmentLog(self.part)

    def create(self) -> None:
        """Begin from nothing: make an empty part with the metadata of every array."""
        with disk_full_named(self.part):
            begin_build(self.target)
            for spec in self.specs.values():
                spec.create(self.part)

    def allocate(self) -> None:
        """Reserve space for all chunks that are not linked."""
        for name in self.specs:
            self.files(name).allocate()

    def linkable(self, name: str, source_spec: ArraySpec, rows: int) -> int:
        """How many chunks lie completely in the first `rows` rows and have the source's layout."""
        spec = self.specs[name]
        cuts = {(cut.chunk_rows, cut.row_bytes, cut.dtype) for cut in (spec, source_spec)}
        if len(cuts) > 1 or name in INCREMENTAL:
            return 0
        return min(rows // spec.chunk_rows, spec.chunk_count, source_spec.chunk_count)

    def link_unchanged(self, name: str, source: Path, source_spec: ArraySpec, rows: int) -> None:
        """Link the linkable chunks of the first `rows` rows from a finished store.

        A chunk that does not give its trailer is not linked, but written anew.
        """
        for chunk in range(self.linkable(name, source_spec, rows)):
            path = chunk_path(source, source_spec, chunk)
            if not read_chunk(path, source_spec).damage and not self.files(name).link(chunk, path):
                return

    def write(self, name: str, start: int, values: NDArray[Any]) -> None:
        """Write consecutive rows of a stream, tick or episode array."""
        self.files(name).write(start, values)

    def finish_layout(
        self, attributes: Mapping[str, Any], vl_attributes: Mapping[str, Any]
    ) -> None:
        """Write the checksums of streams, ticks and episodes, then the attributes with the plan;
        after that the build can be resumed."""
        for name, files in self._files.items():
            if name in INCREMENTAL:
                files.sync()
            else:
                files.write_trailers()
        with disk_full_named(self.part):
            zarr.open_group(self.part, path="vl", mode="r+").attrs.put(dict(vl_attributes))
            note_metadata(self.part, {**attributes, "plan": self.plan})

    def layout_damage(self) -> str | None:
        """What is wrong with streams, ticks, episodes or metadata of a laid-out build, and where.

        None where they are unchanged. Reads all of them.
        """
        try:
            check_metadata(self.part)
        except StoreIncomplete as error:
            return str(error).removesuffix(f". {mend(self.part)}")
        laid_out = (spec for name, spec in self.specs.items() if name not in INCREMENTAL)
        return find_damage(self.part, laid_out)

    def missing(self) -> NDArray[np.int64]:
        """The missing feature rows, in order.

        A row whose bytes do not give its checksum is missing.
        """
        spec, checksums = self.specs[FEATURES], read_rows(self.part, self.specs[CHECKSUMS])
        step = max(1, 2**26 // max(1, spec.row_bytes))
        for start in range(0, len(checksums), step):
            stored = checksums[start : start + step]
            if stored.any():
                features = read_rows(self.part, spec, start, start + len(stored))
                stored[row_checksums(features) != stored] = 0
        return np.flatnonzero(checksums == 0)

    def environment_index(self, environment: Mapping[str, Any]) -> int:
        """Record the software and hardware that rows are computed with; returns their number."""
        with disk_full_named(self.part):
            return self._environments.index(environment)

    def commit(
        self, rows: Rows, features: NDArray[Any], keys: Sequence[bytes], environment: int
    ) -> None:
        """Write feature rows (row, slot, dim), wait for the disk, then mark them as done."""
        self.mark(rows, keys, self.write_features(rows, features), environment)

    def write_features(self, rows: Rows, features: NDArray[Any]) -> NDArray[np.uint32]:
        """Write feature rows (row, slot, dim), wait for the disk; returns checksums for `mark`.

        Another process or host may call it for rows that no other process writes.
        """
        features = np.asarray(features)
        for run in _runs(rows):
            self.files(FEATURES).write(int(rows[run[0]]), features[run])
        self.files(FEATURES).sync()
        return row_checksums(features)

    def mark(
        self, rows: Rows, keys: Sequence[bytes], checksums: NDArray[np.uint32], environment: int
    ) -> None:
        """Mark feature rows as done: write their environment, keys and, last, checksums.

        Only the coordinating process may call it.
        """
        names = np.frombuffer(b"".join(keys), np.uint8).reshape(len(rows), -1)
        runs = _runs(rows)
        for run in runs:
            start = int(rows[run[0]])
            with disk_full_named(self.part):
                self._environments.note(start, len(run), environment)
            self.files(KEYS).write(start, names[run])
        self.files(KEYS).sync()
        for run in runs:
            self.files(CHECKSUMS).write(int(rows[run[0]]), checksums[run])

    def write_golden(self, rows: Iterable[GoldenFrames]) -> int:
        """Keep the golden rows that give the key of their row; returns how many do not.

        Only for a build that has all its rows. Raises `DiskFull`.
        """
        spec, files = group_attributes(self.part)["feature_spec"], self.files(KEYS)
        rows = list(rows)
        proven = [row for row in rows if row.key(spec) == files.read(row.row, 1).tobytes()]
        write_golden(self.part, sorted(proven, key=lambda golden: golden.row))
        return len(rows) - len(proven)

    def seal(self, *, keep: bool = False) -> None:
        """Check every row, write the trailers and put the store in its place.

        With `keep`, the replaced store becomes `<name>.zarr.previous`. Idempotent: run it again
        after a kill. Raises `StoreIncomplete` when rows are missing, or a file was changed.
        """
        self.finish()
        put_in_place(self.target, keep)

    def finish(self) -> None:
        """The first half of `seal`: the complete store is on the disk, still in the part."""
        missing = self.missing()
        if missing.size:
            raise StoreIncomplete(
                f"{self.part}: {missing.size} feature rows are missing, the first is {missing[0]}. "
                "Run stages.extract again; it computes what is missing."
            )
        for name in self.specs:
            self.files(name).seal()
        with disk_full_named(self.part):
            noted = self._environments.noted
            write_seal(self.part, **({"environment": self._environments.ranges()} if noted else {}))
            self._environments.remove()
        for partial in self.part.rglob("*.partial"):  # a killed write left it
            partial.unlink()
        self.close()
        sync_folders(self.part)

    def close(self) -> None:
        """Close every file."""
        for files in self._files.values():
            files.close()
        self._files.clear()

    def files(self, name: str) -> ChunkFiles:
        """The chunk files of one array."""
        if name not in self._files:
            self._files[name] = ChunkFiles(self.part, self.specs[name])
        return self._files[name]


def _runs(rows: Rows) -> list[NDArray[np.intp]]:
    """The indices into `rows` of each run of consecutive rows, in ascending order."""
    order = np.argsort(rows, kind="stable")
    gaps = np.flatnonzero(np.diff(np.asarray(rows, np.int64)[order]) != 1) + 1
    return np.split(order, gaps)


def sync_folders(root: Path) -> None:
    """Sync every folder and zarr's metadata; data files are synced as they are written."""
    for folder, _, files in os.walk(root):
        sync(Path(folder))
        if "zarr.json" in files:
            sync(Path(folder) / "zarr.json")
