"""How far actions are from the recorded ones, in physical units."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.channels import action_groups, hardly_moving
from pipeline.policy.normalization import Normalization
from pipeline.store import FeatureStore
from pipeline.train.predictions import Actions, Predictions

Errors = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cells:
    """The sets of ticks over which errors are summed; a cell has those of one episode and phase.

    Every figure is a sum over cells: those of episodes, of groups of episodes, or of a phase.
    """

    episode: NDArray[np.int64]
    """(cell,) index in the store."""
    group: NDArray[np.str_]
    """(cell,) the group of its episode; a bootstrap draws groups."""
    phase: NDArray[np.str_]
    """(cell,) empty where phases are not known."""
    ticks: NDArray[np.int64]
    """(cell,) number of ticks."""
    entries: Errors
    """(cell, horizon) valid chunk entries by steps ahead."""


@dataclass(frozen=True, eq=False)
class ActionErrors:
    """Errors of one method, summed over the valid chunk entries of each cell.

    Means are NaN where no entry is valid. Their last axis is the action dimension.
    """

    cells: Cells
    absolute: Errors
    """(cell, horizon, action_dim)."""

    @cached_property
    def mae(self) -> Errors:
        """(action_dim,) mean absolute error."""
        return _ratio(self.absolute.sum(axis=(0, 1)), self.cells.entries.sum())

    @cached_property
    def mae_horizon(self) -> Errors:
        """(horizon, action_dim): by steps ahead."""
        return _ratio(self.absolute.sum(axis=0), self.cells.entries.sum(axis=0)[:, None])

    @cached_property
    def mae_episode(self) -> Errors:
        """(episode, action_dim), the episodes in the order of `Comparison.episodes`."""
        _, place = np.unique(self.cells.episode, return_inverse=True)
        total, count = (
            summed(values.sum(axis=1), place) for values in (self.absolute, self.cells.entries)
        )
        return _ratio(total, count[:, None])


def summed(values: NDArray[Any], place: NDArray[np.intp]) -> Errors:
    """The sums over the rows of `values` with the same place, (place, …)."""
    total = np.zeros((int(place.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(total, place, values)
    return total


@dataclass(frozen=True)
class ActionGroup:
    """Action dimensions whose errors are averaged, in their unit."""

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


ActionSpace = tuple[tuple[str, ...], tuple[str, ...], tuple[ActionGroup, ...], Errors]
"""Names, units, groups and `Comparison.scale` of the action's dimensions."""


@dataclass(frozen=True)
class Comparison:
    """The errors of a policy and of the methods beside it, on the same ticks."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: tuple[ActionGroup, ...]
    scale: Errors
    """(action_dim,): standard deviation over the training ticks, 0 where it does not vary."""
    cells: Cells
    scores: Mapping[str, ActionErrors]
    """By method, the `policy` among them."""
    execute: int = 1
    """Steps of a chunk that a robot executes."""

    @property
    def episodes(self) -> tuple[int, ...]:
        """Store indices of the episodes with ticks here, ascending."""
        return tuple(np.unique(self.cells.episode).tolist())

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return int(self.cells.ticks.sum())

    @property
    def executed(self) -> "Comparison":
        """The comparison over the steps that are executed."""
        return self.part(steps=slice(self.execute))

    def of_phase(self, phase: str) -> "Comparison":
        """The comparison on the ticks of one phase."""
        return self.part(self.cells.phase == phase)

    def part(
        self, here: NDArray[np.bool_] | slice = slice(None), steps: slice = slice(None)
    ) -> "Comparison":
        """The comparison over some cells and some steps of the chunk."""
        cells = Cells(*(values[here] for values in vars(self.cells).values()))
        cells = replace(cells, entries=cells.entries[:, steps])
        scores = {
            name: ActionErrors(cells, score.absolute[here, steps])
            for name, score in self.scores.items()
        }
        return replace(self, cells=cells, scores=scores)

    def weights(self, group: ActionGroup | None = None) -> Errors:
        """(action_dim,) the weight of each dimension in a group's error; None: in `overall`."""
        dimensions = self.varying() if group is None else list(group.dimensions)
        weights = np.zeros(len(self.names))
        weights[dimensions] = 1 / len(dimensions)
        return weights / np.where(self.scale > 0, self.scale, 1) if group is None else weights

    def error(self, method: str, group: ActionGroup | None = None) -> float:
        """Mean absolute error of a group, in its unit; with None, `overall`."""
        return float(self.scores[method].mae @ self.weights(group))

    def overall(self, method: str) -> float:
        """Mean absolute error in units of the training standard deviation.

        The mean over the dimensions that vary, each divided by its standard deviation; on normally
        distributed actions, the mean action has an error of 0.8. If no dimension varies, all count,
        undivided.
        """
        return self.error(method)

    def overall_by_episode(self, method: str) -> Errors:
        """`overall` of each episode, (episode,), in the order of `episodes`."""
        return self.in_training_std(self.scores[method].mae_episode).mean(axis=-1)

    def ranked(self) -> list[int]:
        """Indices into `episodes`, sorted by the policy's `overall_by_episode`, lowest first.

        Episodes of equal error keep their order.
        """
        return np.argsort(self.overall_by_episode("policy"), kind="stable").tolist()

    def varying(self) -> list[int]:
        """The dimensions that vary in training; all, where none does."""
        dimensions = np.flatnonzero(self.scale > 0).tolist()
        return dimensions or list(range(len(self.names)))

    def varying_groups(self) -> list[ActionGroup]:
        """The groups with something to predict."""
        varying = set(self.varying())
        return [group for group in self.groups if varying & set(group.dimensions)]

    def low_variance(self) -> dict[int, float]:
        """The dimensions that hardly vary in training; in `overall` their noise counts like motion.

        Each maps to the usual training deviation of similar dimensions: of those with similar names
        and the same unit or, for joints named after limbs, of those with the same unit.
        """
        by_unit = hardly_moving(self.scale, [""] * len(self.names), self.units)
        return by_unit | hardly_moving(self.scale, self.names, self.units)

    def without_low_variance(self) -> "Comparison":
        """The comparison in which `low_variance` dimensions have no weight."""
        scale = self.scale.copy()
        scale[list(self.low_variance())] = 0
        return replace(self, scale=scale)

    def in_training_std(self, errors: Errors) -> Errors:
        """Errors (..., action_dim) of the `varying` dimensions, divided by their training std."""
        dimensions = self.varying()
        return errors[..., dimensions] / np.where(self.scale > 0, self.scale, 1)[dimensions]


def action_space(store: FeatureStore, normalization: Normalization) -> ActionSpace:
    """Names, units, groups and `Comparison.scale` of the action's dimensions."""
    action, statistics = store.streams["action"], normalization.action
    names, units = tuple(action["names"]), tuple(action["units"])
    members: dict[tuple[str, str], list[int]] = {}
    for index, group in enumerate(action_groups(names, units)):
        members.setdefault((group, units[index]), []).append(index)
    groups = tuple(ActionGroup(*key, tuple(dimensions)) for key, dimensions in members.items())
    return names, units, groups, statistics.spread


def compare(
    predictions: Predictions,
    others: Mapping[str, Actions],
    space: ActionSpace,
    group: NDArray[np.str_] | None = None,
    phase: NDArray[np.str_] | None = None,
    execute: int = 1,
) -> Comparison:
    """The errors of the policy and of other methods at the same ticks.

    `others` has the actions (tick, horizon or 1, action_dim) of each method; `space` is what
    `action_space` returns. `group` and `phase` (tick,) belong to each tick; without them each
    episode is a group, and phases are not known.
    """
    episodes = predictions.episodes
    labels = [
        episodes.astype(np.str_) if group is None else group,
        np.full(len(episodes), "") if phase is None else phase,
    ]
    codes = np.stack([np.unique(label, return_inverse=True)[1] for label in (episodes, *labels)])
    _, first, place = np.unique(codes, axis=1, return_index=True, return_inverse=True)
    place, valid = place.reshape(-1), predictions.valid
    cells = Cells(
        episodes[first],
        *(label[first] for label in labels),
        ticks=np.bincount(place),
        entries=summed(valid, place),
    )
    errors = {"policy": predictions.error} | {
        name: np.abs(acted - predictions.recorded) for name, acted in others.items()
    }
    scores = {
        name: ActionErrors(cells, summed(error * valid[..., None], place))
        for name, error in errors.items()
    }
    return Comparison(*space, cells, scores, execute)


def _ratio(total: Errors, entries: NDArray[Any] | np.float64) -> Errors:
    count = np.broadcast_to(entries, total.shape)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
