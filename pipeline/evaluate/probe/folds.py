"""The folds of recordings that are held out together, and the ticks that are read."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold

from pipeline.base.errors import StoreMismatch
from pipeline.store import FeatureStore
from pipeline.train.batches import evenly
from pipeline.train.split import episodes_by_group

_PARTS = 4
"""The most parts of a fold; parts are dealt as units. This bounds time and memory."""


@dataclass(frozen=True, eq=False)
class ProbeFolds:
    """The ticks that are read, ascending, and the folds that hold them out, dealt several times."""

    ticks: NDArray[np.int64]
    """(tick,) store-global; the whole action chunk of each lies within its episode."""
    group: NDArray[np.int64]
    """(tick,) the recording of each, counted from 0."""
    deals: NDArray[np.int64]
    """(repeat, group): the fold that holds a recording out in each deal."""
    notes: tuple[str, ...]
    """What a reader of the scores must know about the folds."""

    @property
    def count(self) -> int:
        """Number of folds."""
        return int(self.deals.max()) + 1

    @property
    def recordings(self) -> int:
        """Number of groups."""
        return self.deals.shape[1]

    @property
    def fold(self) -> NDArray[np.int64]:
        """(repeat, tick): the fold that holds a tick out in each deal."""
        return self.deals[:, self.group]


def fold_by_recording(
    store: FeatureStore, folds: int, horizon: int, max_ticks: int | None = None, repeats: int = 1
) -> ProbeFolds:
    """Deal whole recordings `repeats` times to at most `folds` folds of about equally many ticks.

    Episodes that are one recording in several formats share a fold. Ticks whose chunk of `horizon`
    actions reaches beyond the episode's end are left out, so that all steps of the chunk are scored
    on the same ticks; at most `max_ticks` of the others are read, evenly spread. With no more
    recordings than folds, each is held out alone, in a single deal. Raises `StoreMismatch` where
    fewer than two recordings have such ticks.
    """
    recording = np.full(store.ticks, -1, np.int64)
    for index, episodes in enumerate(episodes_by_group(store).values()):
        for episode in episodes:
            stop = max(episode.ticks.start, episode.ticks.stop - horizon + 1)
            recording[episode.ticks.start : stop] = index
    ticks = np.flatnonzero(recording >= 0)
    most = len(ticks) if max_ticks is None else max_ticks
    read = evenly(ticks, most)
    distinct, group = np.unique(recording[read], return_inverse=True)
    recordings = len(distinct)
    if recordings < 2:
        raise StoreMismatch(
            f"{store.path}: expected at least two recordings of {horizon} ticks or more, of which "
            f"each is predicted from the others, found {recordings}. Add recordings to "
            "data.sources and run stages.extract, or set a shorter probe.horizon or more "
            "probe.max_ticks."
        )
    count = min(folds, recordings)
    notes = _notes(store, recordings, folds, horizon)
    if most < len(ticks):
        notes.append(f"{most} of the ticks are read, evenly spread (probe.max_ticks)")
    deals = _deal(group, count, 1 if recordings == count else repeats)
    return ProbeFolds(read, group, deals, tuple(notes))


def _deal(group: NDArray[np.int64], folds: int, repeats: int) -> NDArray[np.int64]:
    """(repeat, group) the fold of each group: parts of about equal size, dealt by a fixed seed."""
    part = np.empty(group.max() + 1, np.int64)
    parts = min(_PARTS * folds, len(part))
    for index, (_, held) in enumerate(GroupKFold(parts).split(group, groups=group)):
        part[group[held]] = index
    rng = np.random.default_rng(0)
    return np.array([rng.permutation(np.arange(parts) % folds)[part] for _ in range(repeats)])


def _notes(store: FeatureStore, recordings: int, folds: int, horizon: int) -> list[str]:
    """Notes on left-out ticks, and on fewer recordings and folds than expected."""
    notes = []
    if horizon > 1:
        notes.append(f"the last {horizon - 1} ticks of each episode lack a whole chunk: left out")
    if recordings < len(store.episodes):
        notes.append(
            f"{len(store.episodes)} episodes make {recordings} recordings: those of one recording "
            f"in several formats count once, and those shorter than {horizon} ticks not at all"
        )
    if recordings < folds:
        notes.append(f"{recordings} recordings make {recordings} folds, not {folds}")
    return notes
