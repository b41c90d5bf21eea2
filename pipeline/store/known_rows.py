"""Take known rows from another store or an abandoned build."""

from collections import defaultdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import StoreIncomplete
from pipeline.store.chunks import (
    check_chunks,
    find_damage,
    read_chunk,
    read_rows,
    row_checksums,
    sealed_trailer,
)
from pipeline.store.documents import EpisodeText
from pipeline.store.episodes import check_index, read_texts
from pipeline.store.paths import laid_out_attributes
from pipeline.store.schema import (
    CHECKSUMS,
    FEATURES,
    KEYS,
    ArraySpec,
    check_agreement,
    chunk_paths,
    read_specs,
    rows_of,
)
from pipeline.store.writer import EnvironmentLog, environment_at


class RowSource:
    """Known feature rows by key, and streams by episode.

    It reads a finished store or a laid-out build, because it reads chunk files without zarr. Raises
    `StoreIncomplete` where a finished store's keys or episodes were changed, unless it is `damaged`
    as everybody knows: then nothing is taken by what was changed.
    """

    def __init__(self, path: Path, *, damaged: bool = False) -> None:
        self.path = path
        self.specs: dict[str, ArraySpec] = read_specs(path)
        self.attributes = laid_out_attributes(path)
        """Its root attributes."""
        check_agreement(path, self.attributes, self.specs)
        self.damaged = damaged
        self._arrays: dict[str, NDArray[Any]] = {}

    @cached_property
    def rows(self) -> dict[bytes, int]:
        """The row of each key."""
        if self._unsure:
            return {}
        keys = self._read(KEYS)
        return {keys[row].tobytes(): int(row) for row in np.flatnonzero(self._read(CHECKSUMS))}

    def keys_of(self, content: str, instruction: str) -> dict[bytes, bytes]:
        """Keys of the rows of episodes with this content and instruction, by frame times.

        With the same files, equal capture times of every view (the bytes of a row of
        `vl/frame_time`) mean equal frames, so that no pixel needs to be decoded.
        """
        episodes = self._episodes_by_text.get((content, instruction), [])
        if not episodes or self._unsure:
            return {}
        names = ("episode/vl_start", "vl/frame_time", KEYS, CHECKSUMS)
        vl_start, frame_time, keys, checksums = map(self._read, names)
        return {
            frame_time[row].tobytes(): keys[row].tobytes()
            for episode in episodes
            for row in range(vl_start[episode], vl_start[episode + 1])
            if checksums[row]
        }

    def take(self, key: bytes) -> tuple[NDArray[Any], dict[str, Any]] | None:
        """The feature row (slot, dim) of a key, and the software and hardware that computed it
        (empty if not recorded); None where the row is unknown or damaged."""
        row = self.rows.get(key)
        if row is None:
            return None
        try:
            values = read_rows(self.path, self.specs[FEATURES], row, row + 1)
        except StoreIncomplete:  # its file is truncated or gone: compute the row again
            return None
        if row_checksums(values)[0] != self._read(CHECKSUMS)[row]:
            return None
        return values[0], environment_at(self._environments, row)

    @cached_property
    def _unsure(self) -> bool:
        """Whether damage leaves no row of which key and features surely belong together.

        Features and checksums of another store or an older copy fit each other.
        """
        if not self.damaged:
            return False
        try:
            self._read(CHECKSUMS)
        except StoreIncomplete:
            return True
        if self._changed(KEYS):
            return True
        spec, seal = self.specs[FEATURES], self.attributes.seal
        return self._changed(CHECKSUMS) and any(
            read_chunk(path, spec, sealed=sealed_trailer(seal, FEATURES, chunk)).damage
            for chunk, path in enumerate(chunk_paths(self.path, spec))
        )

    @cached_property
    def _episodes_by_text(self) -> dict[tuple[str, str], list[int]]:
        episodes = defaultdict[tuple[str, str], list[int]](list)
        for index, text in enumerate(self.texts):
            episodes[text.content, text.instruction].append(index)
        return episodes

    @cached_property
    def _environments(self) -> list[dict[str, Any]]:
        log = EnvironmentLog(self.path)
        return log.ranges() if log.noted else self.attributes.raw.get("environment", [])

    @cached_property
    def texts(self) -> list[EpisodeText]:
        """The texts of all episodes. Equal `digest`: equal rows. Equal `content`: equal streams."""
        index = [name for name in self.specs if name.startswith("episode/")]
        if (self.damaged or not self._finished) and self._changed("vl/frame_time", *index):
            return []  # rows can then be found only by key, frame by frame
        arrays = {name: self._read(name) for name in index}
        check_index(self.path, arrays, rows_of(self.specs))
        return read_texts(self.path, arrays)

    @property
    def _finished(self) -> bool:
        """Whether every chunk has a trailer; in a build, feature rows have none yet."""
        return self.path.suffix in (".zarr", ".previous")

    def _changed(self, *names: str) -> bool:
        specs = [self.specs[name] for name in names]
        return find_damage(self.path, specs, self.attributes.seal) is not None

    def _read(self, name: str) -> NDArray[Any]:
        """All of a small array, read once."""
        if name not in self._arrays:
            if self._finished and not self.damaged:
                check_chunks(self.path, [self.specs[name]], self.attributes.seal)
            self._arrays[name] = read_rows(self.path, self.specs[name])
        return self._arrays[name]
