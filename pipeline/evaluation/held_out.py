"""Which ticks a policy is judged on, and the judgement."""

from collections.abc import Mapping

import numpy as np

from pipeline.batches import Ticks, Windows
from pipeline.checkpoint import PolicyCheckpoint, describe, source_differences, source_of
from pipeline.errors import CheckpointMismatch
from pipeline.evaluation.predictions import Predictions, baselines, predict
from pipeline.evaluation.scores import Comparison, Group, compare
from pipeline.models import Policy, action_groups
from pipeline.normalization import Normalization
from pipeline.store import FeatureStore


def held_out_ranges(store: FeatureStore, ticks: Ticks) -> dict[str, tuple[int, int]]:
    """The held-out ticks of each episode as `source/id` -> [first, stop), counted in the episode.

    So a checkpoint says what it has not seen in a way that outlives episodes added before these.
    """
    ranges = {}
    for episode in store.episodes:
        inside = ticks[(ticks >= episode.ticks.start) & (ticks < episode.ticks.stop)]
        if len(inside):
            first, stop = int(inside[0]), int(inside[-1]) + 1
            assert len(inside) == stop - first, "held-out ticks of an episode lie side by side"
            start = episode.ticks.start
            ranges[f"{episode.source}/{episode.id}"] = (first - start, stop - start)
    return ranges


def held_out_ticks(store: FeatureStore, ranges: Mapping[str, tuple[int, int]]) -> Ticks:
    """The store's ticks of `held_out_ranges`, ascending.

    Raises `CheckpointMismatch` where there are none, or where the store lacks an episode or has a
    shorter one of that name.
    """
    if not ranges:
        raise CheckpointMismatch(
            "the checkpoint lists no held-out episode, so nothing is left to judge it on: it was "
            "trained with train_head.val_fraction 0. Train with a fraction above 0."
        )
    episodes = {f"{episode.source}/{episode.id}": episode for episode in store.episodes}
    missing = [
        name
        for name, (_, stop) in ranges.items()
        if name not in episodes or len(episodes[name].ticks) < stop
    ]
    if missing:
        raise CheckpointMismatch(
            f"{store.path} lacks {len(missing)} of the {len(ranges)} episodes that the checkpoint "
            f"holds out, or has shorter ones: {', '.join(missing[:5])}"
            f"{' …' if len(missing) > 5 else ''}. Name the store it was trained from in "
            "evaluate.store, or train again."
        )
    parts = [
        np.arange(first, stop, dtype=np.int64) + episodes[name].ticks.start
        for name, (first, stop) in ranges.items()
    ]
    return np.sort(np.concatenate(parts))


def check_store(checkpoint: PolicyCheckpoint, store: FeatureStore) -> None:
    """Raise `CheckpointMismatch`, naming what differs, when the policy does not fit this store."""
    differing = source_differences(checkpoint.source, source_of(store))
    if differing:
        raise CheckpointMismatch(
            f"the checkpoint does not fit {store.path}:\n"
            f"{describe(differing, 'the checkpoint', 'the store')}\n"
            "Name the store it was trained from in evaluate.store, extract with the params it was "
            "trained with, or train again: python -m stages.train_head"
        )


def judge(
    policy: Policy,
    store: FeatureStore,
    ticks: Ticks,
    windows: Windows,
    batch_size: int,
    normalization: Normalization,
) -> tuple[Comparison, Predictions]:
    """The policy beside the baselines on these ticks, and its predictions there."""
    predictions = predict(policy, store, ticks, windows, batch_size)
    action, statistics = store.streams["action"], normalization.action
    # A channel that does not vary has a scale of 1 that is not its spread.
    spread = np.where(statistics.scale == statistics.std, statistics.std, 0.0)
    comparison = compare(
        predictions,
        baselines(store, predictions, statistics.mean),
        action["names"],
        action["units"],
        groups_of(action["names"], action["units"]),
        spread,
    )
    return comparison, predictions


def groups_of(names: list[str], units: list[str]) -> tuple[Group, ...]:
    """The action groups that are there, each with the dimensions that share its unit."""
    members: dict[tuple[str, str], list[int]] = {}
    for index, group in enumerate(action_groups(names, units)):
        members.setdefault((group, units[index]), []).append(index)
    return tuple(Group(name, unit, tuple(where)) for (name, unit), where in members.items())
