"""Which recordings are held out together, and which ticks are read."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold

from pipeline.base.errors import StoreMismatch
from pipeline.store import FeatureStore
from pipeline.train.split import episodes_by_recording


@dataclass(frozen=True, eq=False)
class ProbeFolds:
    """The ticks that are read, ascending, the fold that holds each out, and its part of the fold.

    The penalty is chosen by leaving out one part at a time of those that are trained on: a whole
    fold, or a half where there are two folds only. No part divides a VL row.
    """

    ticks: NDArray[np.int64]
    """(tick,) store-global; the whole action chunk of each lies within its episode."""
    fold: NDArray[np.int64]
    """(tick,)"""
    part: NDArray[np.int64]
    """(tick,) counted over all folds."""
    recordings: int
    notes: tuple[str, ...]
    """What the reader of a score has to know about the folds."""

    @property
    def count(self) -> int:
        """Number of folds."""
        return int(self.fold.max()) + 1


def fold_by_recording(
    store: FeatureStore, folds: int, horizon: int, max_ticks: int | None = None
) -> ProbeFolds:
    """Whole recordings in at most `folds` folds of about as many ticks.

    Episodes that are one recording in several formats share a fold. Ticks whose chunk of `horizon`
    actions reaches beyond the episode's end are left out, so that all steps of the chunk are scored
    on the same ticks; of the others, `max_ticks` are read, evenly spread and so of each episode its
    share. Raises `StoreMismatch` where fewer than two recordings have such ticks, or too few.
    """
    recording = np.full(store.ticks, -1, np.int64)
    for index, episodes in enumerate(episodes_by_recording(store).values()):
        for episode in episodes:
            stop = max(episode.ticks.start, episode.ticks.stop - horizon + 1)
            recording[episode.ticks.start : stop] = index
    ticks = np.flatnonzero(recording >= 0)
    group = recording[ticks]
    recordings = len(np.unique(group))
    if recordings < 2:
        raise StoreMismatch(
            f"{store.path}: expected at least two recordings of {horizon} ticks or more, of which "
            f"each is predicted from the others, found {recordings}. Add recordings to "
            "data.sources and run stages.extract, or set a shorter probe.horizon."
        )
    count = min(folds, recordings)
    notes = _notes(store, recordings, folds, horizon)
    # Of two folds only one is trained on: one half of it chooses the other's penalty.
    parts = 4 if count == 2 else count
    if recordings >= parts:
        part = _deal(group, parts)
    else:
        part, row = 2 * _deal(group, 2), store.array("tick/vl_row")[ticks]
        for held in (0, 2):
            part += (part == held) & (row > np.median(row[part == held]))
    if max_ticks is not None and max_ticks < len(ticks):
        read = np.linspace(0, len(ticks) - 1, max_ticks).round().astype(np.int64)
        ticks, part = ticks[read], part[read]
        notes.append(f"{len(ticks)} of the ticks are read, evenly spread (probe.max_ticks)")
    if len(np.unique(part)) < parts:
        raise StoreMismatch(
            f"{store.path}: too few ticks to hold recordings out in turn: one of {count} folds, or "
            "what it would train on, has none. Give a store with more or longer recordings, a "
            "larger probe.max_ticks or a smaller probe.horizon."
        )
    return ProbeFolds(ticks, part * count // parts, part, recordings, tuple(notes))


def _deal(group: NDArray[np.generic], hands: int) -> NDArray[np.int64]:
    """(tick,) which hand has each: whole groups, in hands of about as many ticks."""
    hand = np.zeros(len(group), np.int64)
    for index, (_, held) in enumerate(GroupKFold(hands).split(group, groups=group)):
        hand[held] = index
    return hand


def _notes(store: FeatureStore, recordings: int, folds: int, horizon: int) -> list[str]:
    """Why there are fewer ticks, recordings and folds than one may expect."""
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
