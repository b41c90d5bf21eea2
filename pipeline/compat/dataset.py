"""One data set over every format, with frames or with a store's features."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset, Subset
from tqdm import tqdm

from pipeline.base.config import Source, SplitParams
from pipeline.base.errors import ConfigError, RecordingError
from pipeline.compat.batch import Sample, UnifiedBatch
from pipeline.compat.stores import (
    check_store,
    episodes_of_format,
    episodes_of_recordings,
    read_frames,
    store_in_memory,
)
from pipeline.data import Recording, open_recordings
from pipeline.data.episode import RowFrames, read_episode
from pipeline.data.timeline import choose_action_rotation
from pipeline.store import Episode, FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.split import split_by_episode

Rotation = Literal["auto", "rotvec", "euler_delta"]
Format = Literal["auto", "old", "new", "raw", "lerobot"]
Place = str | Path | Source
"""A path or glob of recordings, or a named source of them."""


class UnifiedVLADataset(Dataset[Sample]):
    """An item for each tick: the windows that end there, the chunk from there, frames or features.

    Without `store` the streams of all recordings are read into memory (2.7 MB for each second of a
    1,026-channel sensor at 650 Hz), and frames are decoded when an item is read. With `store` items
    have its features, of the plain frames only, and no stream or frame of a recording is read;
    `data` then selects recordings (None: all). Ticks and windows are the same as in training in
    both cases: see `build_timeline` and `FeatureStore.gather`.

    `horizon` is in ticks, the windows are in readings, none of them older than `sensor_window_s`
    and `state_window_s` (None: any age). With `action_hz` None, the ticks are the recorded rows or
    those of the store. `instruction` replaces the instructions of `data`. All recordings have one
    kind of `action_rotation`; `auto` is rotvec if every recording has poses.

    Works in DataLoader workers however they are started: unpickling opens the data again. Use
    `unified_collate_fn`. Raises `RecordingError` for recordings that are missing or broken,
    `StoreMismatch` for a store of other ticks or without these recordings, `ConfigError` for
    settings that contradict each other.
    """

    store: FeatureStore
    """The store, or the recordings' streams in memory laid out as one without features."""
    episodes: tuple[Episode, ...]
    """The episodes of this data set in `store`, under the names of its own sources."""
    ticks: NDArray[np.int64]
    """(item,) index in `store` of each item's tick."""

    def __init__(
        self,
        data: Place | Sequence[Place] | None = None,
        format: Format = "auto",
        horizon: int = 8,
        vlm_reuse_count: int = 3,
        sensor_window_size: int = 65,
        state_window_size: int = 100,
        action_hz: float | None = 10.0,
        *,
        sensor_window_s: float | None = 0.1,
        state_window_s: float | None = 1.0,
        instruction: str | None = None,
        views: Sequence[str] | None = None,
        action_rotation: Rotation = "auto",
        store: FeatureStore | str | Path | None = None,
    ) -> None:
        windows = (sensor_window_size, state_window_size, sensor_window_s, state_window_s)
        self.windows = Windows(horizon, *windows)
        self.vlm_reuse_count, self.action_hz = vlm_reuse_count, action_hz
        self.action_rotation: Rotation = action_rotation
        self._sources = named_sources(() if data is None else data, format, instruction)
        self._format, self._views = format, views
        self._cached = FeatureStore.open(store) if isinstance(store, str | Path) else store
        if self._cached is not None and not (instruction is None and views is None):
            raise ConfigError(
                "instruction and views say how recordings are opened, but the store's features are "
                "computed already. Leave these out, or the store"
            )
        self._open()

    def __len__(self) -> int:
        return len(self.ticks)

    def __getitem__(self, index: int) -> Sample:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> UnifiedBatch:
        """These items in one gather; torch's DataLoader calls this for a batch."""
        ticks = self.ticks[np.asarray(indices, np.int64)]
        batch = self.store.gather(ticks, **asdict(self.windows))
        rows = self.store.array("tick/vl_row")[ticks]
        episodes = self.store.episode_of(ticks)
        instructions = [self.store.episodes[episode].instruction for episode in episodes.tolist()]
        return UnifiedBatch(
            **vars(batch),
            tick=torch.from_numpy(ticks),
            time=torch.from_numpy(self.store.array("tick/time")[ticks]),
            episode=torch.from_numpy(episodes),
            vl_row=torch.from_numpy(rows),
            instruction=instructions,
            **self._seen(rows),
        )

    def items_by(self, trait: Literal["source", "format"]) -> dict[str, NDArray[np.int64]]:
        """The items of each source, or of each format, by its name."""
        names = np.array([getattr(episode, trait) for episode in self.episodes])
        of_item = np.repeat(names, [len(episode.ticks) for episode in self.episodes])
        return {name: np.flatnonzero(of_item == name) for name in dict.fromkeys(names.tolist())}

    def split(self, val_fraction: float = 0.15) -> tuple[Subset[Sample], Subset[Sample]]:
        """Items to train on and items held out: whole groups of episodes, by `split_by_episode`.

        With a store these are train and val of `stages.train_head` under `train_head.split` {val:
        `val_fraction`, test: 0}. With frames they are the same if sources and episodes have the
        store's names: the side follows from the hash of "source/id". Use `unified_collate_fn`.
        """
        params = SplitParams(val=val_fraction, test=0)
        split = split_by_episode(self.store, params, self.windows.horizon)
        sides = (np.isin(self.ticks, side) for side in (split.train, split.val))
        train, held_out = (Subset(self, np.flatnonzero(side).tolist()) for side in sides)
        return train, held_out

    def _seen(self, rows: NDArray[np.int64]) -> dict[str, Any]:
        if self._frames is None:
            return {"key": torch.from_numpy(self.store.array("vl/key")[rows])}
        frames = read_frames(self._frames, rows)
        return {"images": [frames[row] for row in rows.tolist()]}

    def _open(self) -> None:
        self._frames: RowFrames | None = None
        if self._cached is None:
            self._read(self._recordings())
        else:
            self.store = self._cached
            check_store(self.store, self.vlm_reuse_count, self.action_hz, self.action_rotation)
            self.episodes = tuple(
                episodes_of_recordings(self.store, self._recordings())
                if self._sources
                else episodes_of_format(self.store, self._format)
            )
        ranges = [np.arange(episode.ticks.start, episode.ticks.stop) for episode in self.episodes]
        self.ticks = np.concatenate(ranges, dtype=np.int64)

    def _read(self, recordings: Sequence[Recording]) -> None:
        rotation = choose_action_rotation(self.action_rotation, recordings)
        settings = (self.action_hz, self.vlm_reuse_count)
        bar = tqdm(recordings, "reading", unit="episode", disable=None, leave=False)
        read = [read_episode(recording, *settings, rotation) for recording in bar]
        self.store, self._frames = store_in_memory(read, *settings)
        self.episodes = self.store.episodes

    def _recordings(self) -> Sequence[Recording]:
        if not self._sources:
            raise ConfigError(
                "a data set needs recordings or a store, found neither. Name a folder of "
                "recordings, or pass store=cache_store/NAME.zarr"
            )
        opened = open_recordings(self._sources, views=self._views)
        if opened.bad:
            lines = "".join(f"\n  {bad.source}: {bad.reason}" for bad in opened.bad)
            raise RecordingError(
                f"{len(opened.bad)} episodes cannot be used; mend or remove them:{lines}"
            )
        return opened.recordings

    def __getstate__(self) -> dict[str, Any]:
        # Streams and file handles are not pickled: unpickling opens the data again.
        opened = ("store", "episodes", "ticks", "_frames")
        return {name: value for name, value in vars(self).items() if name not in opened}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._open()


class AsyncInsertionMeca500DatasetWithSensor(UnifiedVLADataset):
    """`UnifiedVLADataset(..., format="old")`."""

    def __init__(self, data: Place | Sequence[Place] | None = None, **settings: Any) -> None:
        super().__init__(data, "old", **settings)


class NewAsyncInsertionDataset(UnifiedVLADataset):
    """`UnifiedVLADataset(..., format="new")`."""

    def __init__(self, data: Place | Sequence[Place] | None = None, **settings: Any) -> None:
        super().__init__(data, "new", **settings)


def named_sources(
    data: Place | Sequence[Place], format: Format, instruction: str | None = None
) -> tuple[Source, ...]:
    """The named sources, and all bare paths as one source named after the format."""
    places = [data] if isinstance(data, str | Path | Source) else list(data)
    named = [place for place in places if isinstance(place, Source)]
    paths = tuple(str(place) for place in places if not isinstance(place, Source))
    if paths:
        name = "recordings" if format == "auto" else format
        named.append(Source(name=name, path=paths, format=format))
    if instruction is not None:
        named = [source.model_copy(update={"instruction": instruction}) for source in named]
    return tuple(named)
