"""Which recordings are held out together, and which ticks are read."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import StoreMismatch
from pipeline.store import Episode, FeatureStore
from pipeline.train.split import episodes_by_recording


@dataclass(frozen=True, eq=False)
class Folds:
    """The ticks that are read, ascending, and the part of a fold that each belongs to.

    The parts of a fold are held out together; the penalty is chosen by leaving out one part at a
    time of those that are trained on. No part divides a VL row.
    """

    ticks: NDArray[np.int64]
    """(tick,) store-global; the whole action chunk of each lies within its episode."""
    part: NDArray[np.int64]
    """(tick,) index into `fold_of_part`."""
    fold_of_part: tuple[int, ...]
    recordings: int
    notes: tuple[str, ...]
    """What the reader of a score has to know about the folds."""

    @property
    def fold(self) -> NDArray[np.int64]:
        """(tick,) the fold that each is held out in."""
        return np.asarray(self.fold_of_part)[self.part]

    @property
    def count(self) -> int:
        """Number of folds."""
        return max(self.fold_of_part) + 1


def fold_by_recording(
    store: FeatureStore, folds: int, horizon: int, max_ticks: int | None = None
) -> Folds:
    """Whole recordings in at most `folds` folds of about as many ticks.

    Episodes that are one recording in several formats share a fold. Ticks whose chunk of `horizon`
    actions reaches beyond the episode's end are left out, so that all steps of the chunk are scored
    on the same ticks; `max_ticks` takes that many of the others, evenly spread. Raises
    `StoreMismatch` where fewer than two recordings have such ticks.
    """
    recordings = {
        name: found
        for name, episodes in episodes_by_recording(store).items()
        if (found := [one for one in episodes if len(one.ticks) >= horizon])
    }
    if len(recordings) < 2:
        raise StoreMismatch(
            f"{store.path}: expected at least two recordings of {horizon} ticks or more, of which "
            f"each is predicted from the others, found {len(recordings)}. Add recordings to "
            "data.sources and run stages.extract, or set a shorter probe.horizon."
        )
    notes = _left_out(store, len(recordings), horizon)
    if len(recordings) < folds:
        notes.append(f"{len(recordings)} recordings make {len(recordings)} folds, not {folds}")
    count = min(folds, len(recordings))
    part = np.full(store.ticks, -1, np.int64)
    if count > 2:
        fold_of_part = tuple(range(count))
        for index, names in enumerate(_dealt(recordings, count)):
            _mark(part, [one for name in names for one in recordings[name]], index, horizon)
    else:
        # What is trained on is then a single fold, of which one half chooses the other's penalty.
        fold_of_part = (0, 0, 1, 1)
        for fold, names in enumerate(_dealt(recordings, 2)):
            _halve(part, {name: recordings[name] for name in names}, 2 * fold, horizon, store)
    ticks = np.flatnonzero(part >= 0)
    if max_ticks is not None and max_ticks < len(ticks):
        ticks = ticks[np.linspace(0, len(ticks) - 1, max_ticks).round().astype(np.int64)]
        notes.append(f"{len(ticks)} of the ticks are read, evenly spread")
    return Folds(ticks, part[ticks], fold_of_part, len(recordings), tuple(notes))


def _left_out(store: FeatureStore, recordings: int, horizon: int) -> list[str]:
    """Why there are fewer ticks and recordings than the store has ticks and episodes."""
    notes = [
        f"of {store.ticks} ticks, the last {horizon - 1} of each episode are left out, as their "
        f"chunk of {horizon} would pass its end"
    ]
    if recordings < len(store.episodes):
        notes.append(
            f"{len(store.episodes)} episodes make {recordings} recordings: those of one recording "
            f"in several formats count once, and those shorter than {horizon} ticks not at all"
        )
    return notes if horizon > 1 else notes[1:]


def _dealt(recordings: dict[str, list[Episode]], hands: int) -> list[list[str]]:
    """The longest recording first, each to the hand with the fewest ticks."""
    length = {name: sum(len(e.ticks) for e in episodes) for name, episodes in recordings.items()}
    dealt: list[list[str]] = [[] for _ in range(hands)]
    held = [0] * hands
    for name in sorted(recordings, key=lambda name: (-length[name], name)):
        hand = held.index(min(held))
        dealt[hand].append(name)
        held[hand] += length[name]
    return dealt


def _mark(part: NDArray[np.int64], episodes: list[Episode], index: int, horizon: int) -> None:
    for episode in episodes:
        part[episode.ticks.start : episode.ticks.stop - horizon + 1] = index


def _halve(
    part: NDArray[np.int64],
    recordings: dict[str, list[Episode]],
    first: int,
    horizon: int,
    store: FeatureStore,
) -> None:
    """Two parts of a fold: recordings where it has several, else the halves of the only one."""
    if len(recordings) > 1:
        for index, names in enumerate(_dealt(recordings, 2)):
            _mark(part, [one for name in names for one in recordings[name]], first + index, horizon)
        return
    rows = store.array("tick/vl_row")
    for episode in next(iter(recordings.values())):
        _mark(part, [episode], first, horizon)
        span = slice(episode.ticks.start, episode.ticks.stop - horizon + 1)
        middle = (rows[span][0] + rows[span][-1]) // 2
        part[span][rows[span] > middle] = first + 1
