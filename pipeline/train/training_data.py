"""The training data that a checkpoint describes, and how it is found again in a store."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.differences import describe, differences
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.base.printed_commands import command
from pipeline.base.provenance import SIDES, Side, SplitPart, TunedPart, tuned_on_of_store
from pipeline.policy.checkpoint import SOURCE_KEYS, PolicyCheckpoint
from pipeline.store import Episode, FeatureStore, episode_name
from pipeline.train.split import Split, ticks_of

_SHOWN = 5
"""Episodes that an error lists."""


def source_of(store: FeatureStore) -> dict[str, Any]:
    """The description of a store that a checkpoint keeps, and that another store must equal."""
    return {key: getattr(store, "spec" if key == "feature_spec" else key) for key in SOURCE_KEYS}


def list_differences(expected: Any, actual: Any) -> str:
    """Where two documents differ, an indented line each; empty where they are equal."""
    return "\n".join(f"  {line}" for line in describe(differences(expected, actual)))


def check_store(checkpoint: PolicyCheckpoint, store: FeatureStore) -> None:
    """Raise `CheckpointMismatch`, naming what differs, where the policy does not fit the store."""
    if differing := list_differences(checkpoint.source, source_of(store)):
        raise CheckpointMismatch(
            f"the checkpoint does not fit {store.path} (the checkpoint -> the store):\n"
            f"{differing}\nName the store it was trained from in evaluate.store, extract with the "
            f"params it was trained with, or train again: {command('train_head')}"
        )


def split_parts(store: FeatureStore, split: Split) -> dict[Side, dict[str, SplitPart]]:
    """The episodes of each side by "source/id", as a checkpoint lists them.

    Ticks are counted in the episode, so that they stay true when episodes are added to the store.
    """
    return {side: _parts(store, getattr(split, side), split.groups) for side in SIDES}


def _parts(
    store: FeatureStore, ticks: NDArray[np.int64], groups: Mapping[str, str]
) -> dict[str, SplitPart]:
    edges = np.searchsorted(ticks, store.array("episode/tick_start"))
    parts = {}
    for index in np.flatnonzero(np.diff(edges)):
        episode, inside = store.episodes[index], ticks[edges[index] : edges[index + 1]]
        name, start = episode_name(episode), episode.ticks.start
        first, stop = int(inside[0]) - start, int(inside[-1]) + 1 - start
        assert len(inside) == stop - first, "ticks of an episode on one side lie side by side"
        parts[name] = SplitPart(ticks=(first, stop), content=episode.content, group=groups[name])
    return parts


def find_ticks(
    store: FeatureStore, checkpoint: PolicyCheckpoint, side: Side
) -> tuple[NDArray[np.int64], PolicyCheckpoint]:
    """The store's ticks of a side, ascending, and the checkpoint with the store's episode names.

    An episode whose source or folder was renamed is recognised by the digest of its files. Raises
    `CheckpointMismatch` where the side has no episode, or where the store lacks an episode, has a
    shorter one of that name, or one made from other files.
    """
    parts = checkpoint.split[side]
    if not parts:
        raise CheckpointMismatch(
            f"the checkpoint lists no {side} episode, so there is nothing to look at: it was "
            f"trained with train_head.split.{side} 0, or on too short a recording. Train again "
            f"with train_head.split.{side} above 0."
        )
    left: dict[str, dict[str, Episode]] = {}
    for episode in store.episodes:
        left.setdefault(episode.content, {})[episode_name(episode)] = episode
    matches: list[tuple[Episode, SplitPart]] = []
    wrong: list[str] = []
    for name, part in parts.items():
        alike = left.get(part.content, {})
        episode = alike.pop(name, None)
        if episode is None and alike:  # renamed since
            episode = alike.popitem()[1]
        if episode is None or len(episode.ticks) < part.ticks[1]:
            wrong.append(name)
        else:
            matches.append((episode, part))
    if wrong:
        raise CheckpointMismatch(
            f"{store.path}: of the {len(parts)} {side} episodes of the checkpoint, {len(wrong)} "
            f"are missing, shorter, or other recordings than they were: "
            f"{', '.join(wrong[:_SHOWN])}{' …' if len(wrong) > _SHOWN else ''}. Name the store it "
            "was trained from in evaluate.store, or train again."
        )
    named = {episode_name(episode): part for episode, part in matches}
    return (
        ticks_of([episode for episode, _ in matches], [part.ticks for _, part in matches]),
        replace(checkpoint, split={**checkpoint.split, side: named}),
    )


def groups_of(
    store: FeatureStore, checkpoint: PolicyCheckpoint, ticks: NDArray[np.int64]
) -> NDArray[np.str_]:
    """(tick,) the group of each tick's episode; `ticks` come from `find_ticks`."""
    parts = chain.from_iterable(side.values() for side in checkpoint.split.values())
    # By content: a renamed episode keeps its group, and episodes of equal content share one.
    group_of = {part.content: part.group for part in parts}
    indices, place = np.unique(store.episode_of(ticks), return_inverse=True)
    return np.array([group_of[store.episodes[index].content] for index in indices], str)[place]


def refuse_tuned_episodes(store: FeatureStore, split: Split) -> list[str]:
    """Refuse a split that holds out episodes the model was tuned on; returns notes to print.

    Raises `ConfigError` where test has an episode that the model was tuned or chosen on, or val
    one that it was tuned on.
    """
    tuned = tuned_on_of_store(store.attrs, store.path)
    if tuned is None:
        if not store.spec.get("adapter"):
            return []
        return [
            f"the adapter of {store.path} does not say what it was tuned on, so nobody can tell "
            "whether the held-out episodes are new to it"
        ]
    parts = split_parts(store, split)
    seen = {
        "test": _seen(parts["test"], (*tuned.train, *tuned.val)),
        "val": _seen(parts["val"], tuned.train),
    }
    if any(seen.values()):
        lines = [f"{side}: {', '.join(names[:_SHOWN])}" for side, names in seen.items() if names]
        raise ConfigError(
            f"{store.path}: the model of its features was tuned on episodes that train_head.split "
            f"holds out, the first ({'; '.join(lines)}), so what is reported on them would flatter "
            "it. Set train_head.split to what stages.finetune had, the same seed above all, or "
            "extract with a model that was not tuned on them."
        )
    return []


def _seen(parts: Mapping[str, SplitPart], tuned: Iterable[TunedPart]) -> list[str]:
    """The episodes of these parts whose groups have ticks that the model has seen."""
    known: dict[str, list[tuple[int, int]]] = {}
    for part in tuned:
        known.setdefault(part.content, []).append(part.ticks)
    groups = {
        part.group
        for part in parts.values()
        if any(a < part.ticks[1] and part.ticks[0] < b for a, b in known.get(part.content, ()))
    }
    return sorted(name for name, part in parts.items() if part.group in groups)
