"""How far actions are from the recorded ones, in physical units."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.channels import hardly_moving
from pipeline.policy.normalization import Normalization
from pipeline.policy.observation import action_groups
from pipeline.policy.policy import Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import Ticks, Windows
from pipeline.train.predictions import (
    BASELINES,
    Actions,
    FeedMaker,
    Predictions,
    baselines,
    predict,
)

Errors = NDArray[np.float64]


@dataclass(frozen=True)
class ActionErrors:
    """Mean absolute and root mean square error of one way to act, over valid chunk entries.

    NaN where no entry is valid. The last axis is the action dimension.
    """

    mae: Errors
    rmse: Errors
    mae_horizon: Errors
    """(horizon, action_dim): by steps ahead."""
    rmse_horizon: Errors
    mae_episode: Errors
    """(episode, action_dim), the episodes in the order of `Comparison.episodes`."""


@dataclass(frozen=True)
class ActionGroup:
    """Action dimensions that are summed up together: mean of their errors, in their unit."""

    name: str
    unit: str
    dimensions: tuple[int, ...]

    @property
    def key(self) -> str:
        """Name and unit as one word for a metrics file."""
        return f"{self.name}_{self.unit}" if self.unit else self.name

    def mean(self, errors: Errors) -> Errors:
        """The group's mean over the last axis."""
        return errors[..., list(self.dimensions)].mean(axis=-1)


@dataclass(frozen=True)
class Comparison:
    """A policy beside the baselines on the same ticks."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: tuple[ActionGroup, ...]
    scale: Errors
    """(action_dim,): standard deviation over the training ticks, 0 where it does not vary."""
    episodes: tuple[int, ...]
    """Store indices of the episodes with ticks here."""
    ticks: int
    scores: Mapping[str, ActionErrors]

    def overall(self, method: str) -> float:
        """Mean absolute error in units of the training standard deviation.

        The mean over the dimensions that vary, each divided by its own standard deviation; of
        normally distributed actions, always acting the mean then costs 0.8. Where none varies, all
        count, undivided.
        """
        return float(self.in_training_std(self.scores[method].mae).mean())

    def overall_by_episode(self, method: str) -> Errors:
        """`overall` of each episode, (episode,), in the order of `episodes`."""
        return self.in_training_std(self.scores[method].mae_episode).mean(axis=-1)

    def ranked(self) -> list[int]:
        """Places in `episodes`, from the one that the policy follows best to the one it does worst.

        By `overall_by_episode`; of equals, the first comes first.
        """
        return np.argsort(self.overall_by_episode("policy"), kind="stable").tolist()

    def extremes(self) -> list[tuple[str, int]]:
        """The episodes of lowest and highest error: what to call each, and its store index.

        Only one where there is no other.
        """
        order = self.ranked()
        best, worst = order[0], order[-1]
        if best == worst:
            return [("the held-out episode", self.episodes[best])]
        return [("lowest error", self.episodes[best]), ("highest error", self.episodes[worst])]

    def varying(self) -> list[int]:
        """The dimensions that vary in training; all, where none does."""
        dimensions = np.flatnonzero(self.scale > 0).tolist()
        return dimensions or list(range(len(self.names)))

    def varying_groups(self) -> list[ActionGroup]:
        """The groups with something to predict."""
        varying = set(self.varying())
        return [group for group in self.groups if varying & set(group.dimensions)]

    def low_variance(self) -> dict[int, float]:
        """The dimensions that vary, but hardly: in `overall`, noise that counts like a motion.

        Each with the usual training deviation of those alike.
        """
        return hardly_moving(self.scale, self.names, self.units)

    def without_low_variance(self) -> "Comparison":
        """The same, in which what is `low_variance` counts as not varying: it weighs nothing."""
        scale = self.scale.copy()
        scale[list(self.low_variance())] = 0
        return replace(self, scale=scale)

    def in_training_std(self, errors: Errors) -> Errors:
        """Errors (..., action_dim) of the `varying` dimensions, by their training deviations."""
        dimensions = self.varying()
        return errors[..., dimensions] / np.where(self.scale > 0, self.scale, 1)[dimensions]

    def group_mae(self, method: str, group: ActionGroup) -> float:
        """Mean absolute error of a group, in its unit."""
        return float(group.mean(self.scores[method].mae))

    def group_rmse(self, method: str, group: ActionGroup) -> float:
        """Root mean square error of a group, in its unit."""
        return float(np.sqrt(group.mean(self.scores[method].rmse ** 2)))

    def relative(self, group: ActionGroup | None = None) -> float | None:
        """The policy's mean absolute error divided by that of the best baseline; below 1 it wins.

        None for a group that never varies in training, where the mean action is right by itself.
        """
        if group is not None and not (self.scale[list(group.dimensions)] > 0).any():
            return None
        errors = {
            method: self.overall(method) if group is None else self.group_mae(method, group)
            for method in ("policy", *BASELINES)
        }
        best = min(errors[method] for method in BASELINES)
        return errors["policy"] / best if best > 0 else None


def evaluate_policy(
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
    members: dict[tuple[str, str], list[int]] = {}
    for index, group in enumerate(action_groups(action["names"], action["units"])):
        members.setdefault((group, action["units"][index]), []).append(index)
    comparison = compare(
        predictions,
        baselines(store, predictions, statistics.mean),
        action["names"],
        action["units"],
        [ActionGroup(*key, tuple(dimensions)) for key, dimensions in members.items()],
        # A channel that does not vary has a scale of 1 that is not its spread.
        np.where(statistics.scale == statistics.std, statistics.std, 0.0),
    )
    return comparison, predictions


def compare(
    predictions: Predictions,
    baselines: Mapping[str, Actions],
    names: Sequence[str],
    units: Sequence[str],
    groups: Sequence[ActionGroup],
    scale: NDArray[np.floating],
) -> Comparison:
    """The scores of the policy and of each baseline on these predictions."""
    ways = {"policy": predictions.predicted, **baselines}
    episodes, place = np.unique(predictions.episodes, return_inverse=True)
    return Comparison(
        names=tuple(names),
        units=tuple(units),
        groups=tuple(groups),
        scale=np.asarray(scale, np.float64),
        episodes=tuple(episodes.tolist()),
        ticks=len(predictions.ticks),
        scores={name: _score(acted, predictions, place) for name, acted in ways.items()},
    )


def _score(acted: Actions, predictions: Predictions, episode: NDArray[np.intp]) -> ActionErrors:
    valid = predictions.valid.astype(np.float64)
    error = (acted.astype(np.float64) - predictions.recorded) * valid[..., None]
    absolute, squared = np.abs(error), error**2
    count = valid.sum()
    count_horizon = valid.sum(axis=0)[:, None]
    episodes = int(episode.max()) + 1
    by_episode = np.zeros((episodes, error.shape[2]))
    np.add.at(by_episode, episode, absolute.sum(axis=1))
    count_episode = np.bincount(episode, valid.sum(axis=1), episodes)[:, None]
    return ActionErrors(
        mae=_ratio(absolute.sum(axis=(0, 1)), count),
        rmse=np.sqrt(_ratio(squared.sum(axis=(0, 1)), count)),
        mae_horizon=_ratio(absolute.sum(axis=0), count_horizon),
        rmse_horizon=np.sqrt(_ratio(squared.sum(axis=0), count_horizon)),
        mae_episode=_ratio(by_episode, count_episode),
    )


def _ratio(total: Errors, entries: NDArray[Any] | np.float64) -> Errors:
    count = np.broadcast_to(entries, total.shape)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
