"""Which ticks a policy is judged on, and the judgement."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from pipeline.base.differences import describe
from pipeline.base.errors import CheckpointMismatch
from pipeline.policy.checkpoint import PolicyCheckpoint, source_differences
from pipeline.policy.normalization import Normalization
from pipeline.policy.observation import action_groups
from pipeline.policy.policy import Trainable
from pipeline.store import FeatureStore, episode_name
from pipeline.train.batches import Ticks, Windows
from pipeline.train.identity import source_of
from pipeline.train.predictions import FeedMaker, Predictions, baselines, predict
from pipeline.train.scores import Comparison, Group, compare


def held_out_ranges(store: FeatureStore, ticks: Ticks) -> dict[str, tuple[int, int]]:
    """The held-out ticks of each episode as `source/id` -> [first, stop), counted in the episode.

    So a checkpoint says what it has not seen in a way that outlives episodes added before these.
    """
    ticks = np.sort(ticks)
    edges = np.searchsorted(ticks, store.array("episode/tick_start"))
    ranges = {}
    for index in np.flatnonzero(np.diff(edges)):
        first, stop = int(ticks[edges[index]]), int(ticks[edges[index + 1] - 1]) + 1
        count = edges[index + 1] - edges[index]
        assert count == stop - first, "held-out ticks of an episode lie side by side"
        episode = store.episodes[index]
        start = episode.ticks.start
        ranges[episode_name(episode)] = (first - start, stop - start)
    return ranges


def held_out_contents(store: FeatureStore, names: Collection[str]) -> dict[str, str]:
    """The digest of the files of each of these episodes, by name."""
    known = {episode_name(episode): episode.content for episode in store.episodes}
    return {name: known[name] for name in names}


def held_out_ticks(
    store: FeatureStore, ranges: Mapping[str, tuple[int, int]], contents: Mapping[str, str]
) -> Ticks:
    """The store's ticks of `held_out_ranges`, ascending.

    Raises `CheckpointMismatch` where there are none, or where the store lacks an episode, has a
    shorter one of that name, or one made from other files than `contents` says.
    """
    if not ranges:
        raise CheckpointMismatch(
            "the checkpoint lists no held-out episode, so nothing is left to judge it on: it was "
            "trained with train_head.val_fraction 0. Train with a fraction above 0."
        )
    episodes = {episode_name(episode): episode for episode in store.episodes}
    missing = [
        name
        for name, (_, stop) in ranges.items()
        if name not in episodes or len(episodes[name].ticks) < stop
    ]
    altered = [
        name
        for name in ranges
        if name not in missing and episodes[name].content != contents.get(name)
    ]
    for what, names in (
        ("lacks {} of the {} episodes that the checkpoint holds out, or has shorter ones", missing),
        (
            "has other recordings under the names of {} of the {} held-out episodes, or the same "
            "ones, read otherwise since",
            altered,
        ),
    ):
        if names:
            raise CheckpointMismatch(
                f"{store.path} {what.format(len(names), len(ranges))}: {', '.join(names[:5])}"
                f"{' …' if len(names) > 5 else ''}. Name the store it was trained from in "
                "evaluate.store, or train again."
            )
    parts = [
        np.arange(first, stop, dtype=np.int64) + episodes[name].ticks.start
        for name, (first, stop) in ranges.items()
    ]
    return np.sort(np.concatenate(parts))


def named_as_in(
    store: FeatureStore, checkpoint: PolicyCheckpoint
) -> tuple[PolicyCheckpoint, str | None]:
    """The checkpoint with its held-out episodes under this store's names, and what to say of it.

    An episode whose source or folder was renamed since is told by the digest of its files.
    """
    contents = checkpoint.held_out_content
    ours = {episode_name(one): one.content for one in store.episodes}
    same = {name for name in contents if ours.get(name) == contents[name]}
    free: dict[str, list[str]] = {}
    for name in sorted(ours.keys() - same, reverse=True):
        free.setdefault(ours[name], []).append(name)
    now = {
        name: free[content].pop() if name not in same and free.get(content) else name
        for name, content in contents.items()
    }
    renamed = [f"{name} is {now[name]}" for name in contents if now[name] != name]
    if not renamed or len(set(now.values())) < len(now):  # one of two under one name is not there
        return checkpoint, None
    ticks = {now.get(name, name): range_ for name, range_ in checkpoint.held_out_ticks.items()}
    said = f"{', '.join(renamed[:3])}{' …' if len(renamed) > 3 else ''}"
    return (
        replace(
            checkpoint,
            held_out_ticks=ticks,
            held_out_content={now[name]: content for name, content in contents.items()},
        ),
        f"{len(renamed)} held-out episode(s) were renamed since the training and are told by their "
        f"content: {said}",
    )


def check_store(checkpoint: PolicyCheckpoint, store: FeatureStore) -> None:
    """Raise `CheckpointMismatch`, naming what differs, when the policy does not fit this store."""
    differing = source_differences(checkpoint.source, source_of(store))
    if differing:
        lines = "\n".join(f"  {line}" for line in describe(differing))
        raise CheckpointMismatch(
            f"the checkpoint does not fit {store.path} (the checkpoint -> the store):\n{lines}\n"
            "Name the store it was trained from in evaluate.store, extract with the params it was "
            "trained with, or train again: python -m stages.train_head"
        )


def judge(
    policy: Trainable,
    store: FeatureStore,
    ticks: Ticks,
    windows: Windows,
    batch_size: int,
    normalization: Normalization,
    progress: bool = False,
    samples: int = 1,
    feed: FeedMaker | None = None,
) -> tuple[Comparison, Predictions]:
    """The policy beside the baselines on these ticks, and its predictions there.

    `samples`, `feed` and what is raised are those of `predict`.
    """
    predictions = predict(policy, store, ticks, windows, batch_size, progress, samples, feed)
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
