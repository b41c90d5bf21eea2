"""Take over what another store or an abandoned build already knows."""

import json
from contextlib import closing
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.base.errors import StoreIncomplete
from pipeline.store.chunks import ChunkFiles, row_checksums
from pipeline.store.environments import EnvironmentLog, environment_at
from pipeline.store.schema import CHECKSUMS, FEATURES, KEYS, ArraySpec, read_specs


class RowSource:
    """Known feature rows by key, and streams by episode.

    Works on a finished store and on a laid-out build alike: it reads chunk files, not chunks.
    Raises `StoreIncomplete` where a finished store's keys or episodes are not as they were written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.specs: dict[str, ArraySpec] = read_specs(path)
        self.attrs: dict[str, Any] = zarr.open_group(path, mode="r").attrs.asdict()
        self._features = ChunkFiles(path, self.specs[FEATURES], writable=False)
        self._edges: dict[str, NDArray[np.int64]] = {}

    @property
    def spec_digest(self) -> str:
        """Digest of the feature spec its rows were computed under."""
        return str(self.attrs["feature_spec"]["digest"])

    @cached_property
    def episode_digests(self) -> list[str]:
        """The digest of each episode, in order: equal digest, equal rows."""
        return [said["digest"] for said in self._said]

    @property
    def episode_said(self) -> list[tuple[str, str]]:
        """Content digest and instruction of each episode, in order."""
        return [(said["content"], said["instruction"]) for said in self._said]

    @cached_property
    def episode_contents(self) -> list[str]:
        """The content digest of each episode, in order: equal content, equal streams."""
        return [said["content"] for said in self._said]

    def episode_edges(self, kind: str) -> NDArray[np.int64]:
        """(episode + 1,) offsets of `tick`, `vl`, `sensor` or `state` rows."""
        if kind not in self._edges:
            self._edges[kind] = self._read(f"episode/{kind}_start")
        return self._edges[kind]

    @cached_property
    def rows(self) -> dict[bytes, int]:
        """Where the features of each key are."""
        done = np.flatnonzero(self._checksums)
        keys = self._keys
        return {keys[row].tobytes(): int(row) for row in done}

    def keys_of(self, content: str, instruction: str) -> dict[bytes, bytes]:
        """Keys of the rows of episodes of this content and instruction, by their frame times.

        Under one feature spec, the same files and the same capture time of every view (the bytes
        of a row of `vl/frame_time`) are the same frames: no pixel needs to be decoded to tell.
        """
        return {
            self._frame_time[row].tobytes(): self._keys[row].tobytes()
            for episode in self._episodes_by_said.get((content, instruction), ())
            for row in range(*self.episode_edges("vl")[episode : episode + 2])
            if self._checksums[row]
        }

    def take(self, key: bytes) -> NDArray[Any] | None:
        """The feature row (slot, dim) of a key; None where it is unknown or damaged."""
        row = self.rows.get(key)
        if row is None:
            return None
        try:
            values = self._features.read(row, 1)
        except StoreIncomplete:  # its file is cut short or gone: the row is computed again
            return None
        return values[0] if row_checksums(values)[0] == self._checksums[row] else None

    def environment_of(self, key: bytes) -> dict[str, Any]:
        """With which software and hardware a known row was computed; empty where not noted."""
        return environment_at(self._environments, self.rows[key])

    def close(self) -> None:
        """Close its files."""
        self._features.close()

    @cached_property
    def _episodes_by_said(self) -> dict[tuple[str, str], list[int]]:
        found: dict[tuple[str, str], list[int]] = {}
        for index, said in enumerate(self._said):
            found.setdefault((said["content"], said["instruction"]), []).append(index)
        return found

    @cached_property
    def _frame_time(self) -> NDArray[np.float64]:
        return self._read("vl/frame_time")

    @cached_property
    def _environments(self) -> list[dict[str, Any]]:
        log = EnvironmentLog(self.path)
        return log.ranges() if log.noted else self.attrs.get("environment", [])

    @cached_property
    def _said(self) -> list[dict[str, Any]]:
        if not self._finished and self._index_is_damaged():
            return []  # rows are known by their keys alone, frame by frame
        edges, text = self._read("episode/text_start"), self._read("episode/text").tobytes()
        return [json.loads(text[start:stop]) for start, stop in pairwise(edges)]

    @cached_property
    def _checksums(self) -> NDArray[np.uint32]:
        return self._read(CHECKSUMS)

    @cached_property
    def _keys(self) -> NDArray[np.uint8]:
        return self._read(KEYS)

    @property
    def _finished(self) -> bool:
        """Whether every chunk has a trailer; those of feature rows in a build have none yet."""
        return self.path.suffix in (".zarr", ".previous")

    def _index_is_damaged(self) -> bool:
        """Whether it cannot be relied on which rows of a build are of which episode and instant."""
        for name in ("vl/frame_time", *(name for name in self.specs if name.startswith("episode"))):
            with closing(ChunkFiles(self.path, self.specs[name], writable=False)) as files:
                if any(files.damage(chunk) for chunk in range(len(files.paths))):
                    return True
        return False

    def _read(self, name: str) -> NDArray[Any]:
        with closing(ChunkFiles(self.path, self.specs[name], writable=False)) as files:
            if self._finished:
                files.check()
            return files.read(0, self.specs[name].shape[0])
