"""Groups of episodes so alike that a policy trained on one of them in effect knows the others."""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ConfigError
from pipeline.store import Episode, FeatureStore, episode_name

_TOLERANCE, _RESTING = 1e-3, 0.1
"""How much two equal actions may differ in a channel, as a share of its range in the episode. A
channel at rest varies only by rounding, so its range counts as at least a tenth of the widest
channel's."""


def episodes_by_group(
    store: FeatureStore,
    patterns: Mapping[str, Sequence[str]] | None = None,
    keys: NDArray[np.uint8] | None = None,
) -> dict[str, list[Episode]]:
    """The episodes that have ticks, by group; a group is named by the first "source/id" in it.

    Two episodes share a group if their first VL keys, their files or their actions are equal, if
    their recordings name the same group, if `patterns` (shell wildcards for "source/id", by group
    name) of one group match both, or if both share a group with a third episode. Actions are equal
    if the episodes have the same number of ticks and agree within 0.1 % of their range, so a
    re-encoded copy is recognised. Actions that never change are not compared. `keys` (vl_row, 16)
    replace the store's own.

    Raises `ConfigError` if a pattern matches no episode.
    """
    from scipy.cluster.hierarchy import DisjointSet  # slow to import, not needed when finished

    episodes = [episode for episode in store.episodes if len(episode.ticks)]
    keys = store.array("vl/key") if keys is None else keys
    frame_time = store.array("vl/frame_time")
    together, first = DisjointSet(range(len(episodes))), dict[Hashable, int]()
    for index, episode in enumerate(episodes):
        row = episode.vl_rows.start
        # Without a frame, a row's key depends on the instruction alone.
        key = keys[row].tobytes() if np.isfinite(frame_time[row]).any() else b""
        marks = [("key", key), ("content", episode.content), ("group", episode.group)]
        for mark in (mark for mark in marks if mark[1]):
            together.merge(first.setdefault(mark, index), index)
    for name, index in _fitting(patterns or {}, [episode_name(episode) for episode in episodes]):
        together.merge(first.setdefault(("params", name), index), index)
    for pair in _equal_actions(store.array("tick/action"), episodes):
        together.merge(*pair)
    groups = ([episodes[i] for i in sorted(members)] for members in together.subsets())
    return dict(sorted((min(map(episode_name, group)), group) for group in groups))


def _fitting(
    patterns: Mapping[str, Sequence[str]], names: Sequence[str]
) -> Iterator[tuple[str, int]]:
    """Yields (group, index in `names`) for each name that a pattern of the group matches."""
    for group, wanted in patterns.items():
        for pattern in wanted:
            places = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
            if not places:
                raise ConfigError(
                    f"train_head.split.groups.{group}: expected patterns of episodes of the store, "
                    f"which are called {', '.join(names[:3])}{' …' if len(names) > 3 else ''}; "
                    f"{pattern!r} fits none of {len(names)}."
                )
            yield from ((group, place) for place in places)


def _equal_actions(
    action: NDArray[np.float32], episodes: Sequence[Episode]
) -> Iterator[tuple[int, int]]:
    """Yields the indices in `episodes` of each pair with equal actions (tick, action)."""
    by_length: dict[int, list[int]] = {}
    for index, episode in enumerate(episodes):
        by_length.setdefault(len(episode.ticks), []).append(index)
    for places in by_length.values():
        actions = [action[episodes[i].ticks.start : episodes[i].ticks.stop] for i in places]
        ranges = np.stack([np.ptp(own, axis=0) for own in actions])
        widest = ranges.max(axis=1, keepdims=True)
        tolerance = _TOLERANCE * np.maximum(ranges, _RESTING * widest)
        # First, mean and last action: cheap to compare, and equal where the actions are equal.
        outline = np.stack([[own[0], own.mean(axis=0, dtype=float), own[-1]] for own in actions])
        moving = np.flatnonzero((widest[:, 0] > 0) & (widest[:, 0] < np.inf))
        for rank, own in enumerate(moving):
            others = moving[rank + 1 :]
            allowed = np.maximum(tolerance[others], tolerance[own])
            alike = (np.abs(outline[others] - outline[own]) <= allowed[:, None]).all(axis=(1, 2))
            for other, within in zip(others[alike], allowed[alike], strict=True):
                if np.allclose(actions[other], actions[own], rtol=0, atol=within):
                    yield places[own], places[other]
