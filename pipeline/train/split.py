"""Which ticks are trained on and which are held out; a checkpoint's held-out ticks found again."""

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.differences import describe, differences
from pipeline.base.errors import CheckpointMismatch, ConfigError, StoreMismatch
from pipeline.policy.checkpoint import SOURCE_KEYS, PolicyCheckpoint
from pipeline.store import Episode, FeatureStore, episode_name

_TAIL = 0.2
"""What a single recording holds out of its ticks."""

_SLACK_S = 1e-6
"""Two times that differ by less are one: seconds since 1970 in float64 are this coarse."""


@dataclass(frozen=True, eq=False)
class Split:
    """Store-global ticks, ascending: trained on, and held out with the "source/id" they are of."""

    train: NDArray[np.int64]
    held_out: NDArray[np.int64]
    held_out_episodes: tuple[str, ...]
    note: str | None
    """What the reader of a metric has to know about this split, or None."""


def split_by_episode(
    store: FeatureStore,
    val_fraction: float,
    horizon: int = 8,
    keys: NDArray[np.uint8] | None = None,
) -> Split:
    """Whole episodes on either side, by a hash of "source/id".

    Episodes whose first VL keys are equal are one recording in several formats and share a side,
    by the hash of the first of their names. So an added episode moves none but other formats of
    itself, save where a side would be empty: of two recordings one is held out, one trained on. And
    of two or more recordings of a source one is trained on.

    A single recording is cut at one instant for all of its formats: the earliest at which the last
    20 % of a format's ticks begin. Ticks from there on are held out; ticks before it whose chunk
    of `horizon` actions is not over by then belong to neither side. Raises `ConfigError` where that
    leaves nothing to train on, `StoreMismatch` where the store has no tick. `keys` (vl_row, 16)
    stand in for the VL keys of a store that has none.
    """
    recordings = episodes_by_recording(store, keys)
    if not recordings:
        raise StoreMismatch(
            f"{store.path}: expected ticks to train on, found none. Look at data.sources and run "
            "stages.extract again."
        )
    if val_fraction <= 0:
        return Split(_ticks(store.episodes), _ticks([]), (), None)
    if len(recordings) == 1:
        return _split_tail(store, next(iter(recordings.values())), horizon)
    ranks = {name: hash64(name) / 2**64 for name in recordings}
    chosen = {name for name, rank in ranks.items() if rank < val_fraction}
    notes: list[str] = []
    part = f"val_fraction {val_fraction} of {len(ranks)} recordings"
    if not chosen:
        chosen = {min(ranks, key=lambda name: ranks[name])}
        notes.append(f"{part} is none; one is held out")
    elif len(chosen) == len(ranks):
        chosen.remove(max(ranks, key=lambda name: ranks[name]))
        notes.append(f"{part} is all; one is trained on")
    by_source: dict[str, set[str]] = {}
    for name, episodes in recordings.items():
        for episode in episodes:
            by_source.setdefault(episode.source, set()).add(name)
    for source, names in sorted(by_source.items()):
        if len(names) > 1 and names <= chosen:
            chosen.remove(max(names, key=lambda name: ranks[name]))
            notes.append(f"{part} is all of source {source!r}; one of it is trained on")
    train = [e for name, episodes in recordings.items() if name not in chosen for e in episodes]
    held_out = [e for name in chosen for e in recordings[name]]
    return Split(_ticks(train), _ticks(held_out), _names(held_out), "; ".join(notes) or None)


def episodes_by_recording(
    store: FeatureStore, keys: NDArray[np.uint8] | None = None
) -> dict[str, list[Episode]]:
    """Episodes that have ticks, by the first name among those with the same first VL key.

    Those are one recording in several formats: what is learnt from one is known of the others.
    `keys` (vl_row, 16) stand in for the store's own.
    """
    keys = store.array("vl/key") if keys is None else keys
    frame_time = store.array("vl/frame_time")
    by_key: dict[bytes, list[Episode]] = {}
    for episode in store.episodes:
        if len(episode.ticks):
            row = episode.vl_rows.start
            # The key of a row without a frame says nothing but the instruction.
            key = (
                keys[row].tobytes()
                if np.isfinite(frame_time[row]).any()
                else episode_name(episode).encode()
            )
            by_key.setdefault(key, []).append(episode)
    return {min(_names(episodes)): episodes for episodes in by_key.values()}


def _split_tail(store: FeatureStore, episodes: list[Episode], horizon: int) -> Split:
    named = f"a single recording ({', '.join(_names(episodes))})"
    clocks = [_elapsed(store, episode) for episode in episodes]
    begins = [clock[-n] for clock in clocks if (n := round(_TAIL * len(clock)))]
    if not begins:
        return Split(_ticks(episodes), _ticks([]), (), f"{named}, too short to hold ticks out")
    train, held_out = [], []
    usual = float(np.median(np.concatenate([np.diff(clock) for clock in clocks])))
    for episode, clock in zip(episodes, clocks, strict=True):
        trained, first = _sides(clock, min(begins), horizon, usual)
        train.append(_ticks([episode])[:trained])
        held_out.append(_ticks([episode])[first:])
    if not any(map(len, train)):
        raise ConfigError(
            f"{named} of {', '.join(str(len(clock)) for clock in clocks)} ticks, its last "
            f"{_TAIL:.0%} held out: expected an action chunk of train_head.horizon {horizon} ticks "
            "before those, found none. Set a shorter train_head.horizon or "
            "train_head.val_fraction=0, or add recordings to data.sources."
        )
    note = (
        f"{named}: its last {_TAIL:.0%} of ticks are held out, "
        "which says less than a recording never seen"
    )
    names = _names([e for e, ticks in zip(episodes, held_out, strict=True) if len(ticks)])
    return Split(np.sort(np.concatenate(train)), np.sort(np.concatenate(held_out)), names, note)


def _elapsed(store: FeatureStore, episode: Episode) -> NDArray[np.float64]:
    """The times (tick,) in s since the newest frame of the first VL row: one for all formats.

    Their clocks may differ and their ticks begin apart. Without a view, since the first tick.
    """
    time = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    frames = store.array("vl/frame_time")[episode.vl_rows.start]
    taken = frames[np.isfinite(frames)]
    return time - (taken.max() if len(taken) else time[0])


def _sides(
    clock: NDArray[np.float64], cut: float, horizon: int, usual_step: float
) -> tuple[int, int]:
    """How many leading ticks have chunks that end before the cut, and the first tick at it.

    A clock's last action lasts its median step, and `usual_step` where it has but one tick.
    """
    first = int(np.searchsorted(clock, cut - _SLACK_S))
    last_step = np.median(np.diff(clock)) if len(clock) > 1 else usual_step
    ends = np.append(clock[1:], clock[-1] + last_step)
    # Where ticks of two formats alternate, the action of the tick before the cut lasts beyond it.
    done = first - 1 if first and ends[first - 1] > cut + _SLACK_S else first
    # Chunks do not reach beyond the episode's end.
    return (done if done == len(clock) else max(0, done - (horizon - 1))), first


def _ticks(episodes: Sequence[Episode]) -> NDArray[np.int64]:
    ranges = [np.arange(e.ticks.start, e.ticks.stop, dtype=np.int64) for e in episodes]
    return np.sort(np.concatenate(ranges)) if ranges else np.empty(0, np.int64)


def _names(episodes: Sequence[Episode]) -> tuple[str, ...]:
    return tuple(sorted(episode_name(episode) for episode in episodes))


def hash64(text: str) -> int:
    """A 64-bit hash, the same in every process."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")


def source_of(store: FeatureStore) -> dict[str, Any]:
    """What a checkpoint remembers of its store, and what another store must agree with."""
    return {key: getattr(store, "spec" if key == "feature_spec" else key) for key in SOURCE_KEYS}


def list_differences(expected: Any, actual: Any) -> str:
    """Where two documents differ, on an indented line each; empty where nowhere."""
    return "\n".join(f"  {line}" for line in describe(differences(expected, actual)))


def check_store(checkpoint: PolicyCheckpoint, store: FeatureStore) -> None:
    """Raise `CheckpointMismatch`, naming what differs, when the policy does not fit this store."""
    if differing := list_differences(checkpoint.source, source_of(store)):
        raise CheckpointMismatch(
            f"the checkpoint does not fit {store.path} (the checkpoint -> the store):\n"
            f"{differing}\nName the store it was trained from in evaluate.store, extract with the "
            "params it was trained with, or train again: python -m stages.train_head"
        )


def held_out_ranges(store: FeatureStore, ticks: NDArray[np.int64]) -> dict[str, tuple[int, int]]:
    """The held-out ticks of each episode as `source/id` -> [first, stop), counted in the episode.

    So a checkpoint says what it has not seen in a way that outlives episodes added before these.
    """
    ticks = np.sort(ticks)
    edges = np.searchsorted(ticks, store.array("episode/tick_start"))
    ranges = {}
    for index in np.flatnonzero(np.diff(edges)):
        episode, inside = store.episodes[index], ticks[edges[index] : edges[index + 1]]
        first, stop = int(inside[0]), int(inside[-1]) + 1
        assert len(inside) == stop - first, "held-out ticks of an episode lie side by side"
        start = episode.ticks.start
        ranges[episode_name(episode)] = (first - start, stop - start)
    return ranges


def held_out_contents(store: FeatureStore, names: Collection[str]) -> dict[str, str]:
    """The digest of the files of each of these episodes, by name."""
    known = {episode_name(episode): episode.content for episode in store.episodes}
    return {name: known[name] for name in names}


def find_held_out(
    store: FeatureStore, checkpoint: PolicyCheckpoint
) -> tuple[NDArray[np.int64], PolicyCheckpoint]:
    """The store's held-out ticks, ascending, and the checkpoint with the store's names of them.

    An episode whose source or folder was renamed since is told by the digest of its files. Raises
    `CheckpointMismatch` where nothing is held out, or where the store lacks an episode, has a
    shorter one of that name, or one made from other files.
    """
    ranges, contents = checkpoint.held_out_ticks, checkpoint.held_out_content
    if not ranges:
        raise CheckpointMismatch(
            "the checkpoint lists no held-out episode, so nothing is left to evaluate it on: it "
            "was trained with train_head.val_fraction 0. Train with a fraction above 0."
        )
    by_name = {episode_name(episode): episode for episode in store.episodes}
    renamed: dict[str, list[Episode]] = {}
    for name, episode in by_name.items():
        if contents.get(name) != episode.content:
            renamed.setdefault(episode.content, []).append(episode)
    held_out: list[tuple[Episode, tuple[int, int]]] = []
    wrong: list[str] = []
    for name, (first, stop) in ranges.items():
        episode, content = by_name.get(name), contents.get(name)
        same = episode is not None and episode.content == content
        if not same and (elsewhere := renamed.get(content or "")):
            episode = elsewhere.pop()
        if episode is None:
            wrong.append(f"{name} is missing")
        elif len(episode.ticks) < stop:
            wrong.append(f"{name} is shorter")
        elif episode.content != content:
            wrong.append(f"{name} is another recording, or the same one read otherwise since")
        else:
            held_out.append((episode, (first, stop)))
    if wrong:
        raise CheckpointMismatch(
            f"{store.path}: of the {len(ranges)} episodes that the checkpoint holds out, "
            f"{len(wrong)} are not there as they were: {'; '.join(wrong[:5])}"
            f"{' …' if len(wrong) > 5 else ''}. Name the store it was trained from in "
            "evaluate.store, or train again."
        )
    return (
        np.unique(np.concatenate([np.array(e.ticks[slice(*part)]) for e, part in held_out])),
        replace(
            checkpoint,
            held_out_ticks={episode_name(e): part for e, part in held_out},
            held_out_content={episode_name(e): e.content for e, _ in held_out},
        ),
    )
