"""Baselines: simple rules, fitted on training ticks, that a policy has to beat.

They learn a few numbers for each dimension, except the nearest neighbour, which repeats the actions
of the most similar training tick. A policy that is no better than that has only learnt to look up.
"""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from sklearn.neighbors import NearestNeighbors
from sklearn.preprocessing import StandardScaler
from sklearn.random_projection import SparseRandomProjection

from pipeline.base.arrays import widen
from pipeline.base.channels import hardly_moving
from pipeline.policy.normalization import ChannelStatistics
from pipeline.policy.robot_state import expand
from pipeline.policy.shape import Kind, channel_kinds
from pipeline.store import FeatureStore
from pipeline.train.batches import Ticks, evenly
from pipeline.train.predictions import Actions

BASELINES = ("zero_action", "median_action", "repeat_last", "linear_fit", "nearest_neighbour")
METHODS = ("policy", *BASELINES)
NEIGHBOURS = 20_000
"""The most training ticks among which the nearest is searched."""
_FITTED = 200_000
"""The most training ticks on which the linear fit is fitted."""
_WIDTH = 256
"""Features that are wider than this are projected to this width."""
_ROWS = 512
"""VL rows read at a time."""

Values = Float64[np.ndarray, "tick _"]


class Baselines:
    """The rules, fitted on the training `ticks`; they act on any tick of the same store.

    `features` are the statistics of the features over these ticks; None where the store has none.
    """

    def __init__(
        self, store: FeatureStore, ticks: Ticks, horizon: int, features: ChannelStatistics | None
    ) -> None:
        self._store, self._horizon = store, horizon
        action, units = store.array("tick/action")[ticks], store.streams["action"]["units"]
        self._median = np.median(action, axis=0)
        spread = action.std(axis=0, dtype=np.float64)
        still = list(hardly_moving(spread, [""] * len(spread), units))
        self._moving = np.setdiff1d(np.arange(len(spread)), still)
        fitted = evenly(ticks, _FITTED)
        chunks, valid = recorded_chunks(store, fitted, horizon)
        past = self._past(fitted)
        self._linear = np.stack(
            [
                np.linalg.lstsq(past[valid[:, step]], chunks[valid[:, step], step], rcond=None)[0]
                for step in range(horizon)
            ]
        )
        self._neighbours = Neighbours(store, evenly(ticks, NEIGHBOURS), features)

    def act(self, ticks: Ticks) -> dict[str, Actions]:
        """The actions of each of `BASELINES` at these ticks: (tick, horizon or 1, action_dim).

        `zero_action`: no motion. `median_action`: the median of the training ticks. `repeat_last`:
        the action of the previous tick. `linear_fit`: a linear function of the two previous actions
        (of all dimensions but those that hardly move), by least squares for each step of the chunk.
        Before an episode's first tick, actions count as zero if they are deltas or velocities, and
        as the median if they are absolute: zero would be a pose far from all others.
        `nearest_neighbour`: the chunk of the training tick whose newest state reading and features
        are most alike.
        """
        zero = np.zeros((len(ticks), 1, len(self._median)), np.float32)
        nearest = self._neighbours.nearest(ticks)
        median = zero + self._median.astype(np.float32)
        linear = np.einsum("tp,hpd->thd", self._past(ticks), self._linear)
        return {
            "zero_action": zero,
            "median_action": median,
            "repeat_last": self._before(ticks, 1)[:, None].astype(np.float32),
            "linear_fit": linear.astype(np.float32),
            "nearest_neighbour": median
            if nearest is None
            else recorded_chunks(self._store, nearest, self._horizon)[0],
        }

    def _past(self, ticks: Ticks) -> Values:
        """The two previous actions, and a constant.

        A joint that hardly moves in training is left out: the fit would make much of its noise.
        """
        two = [self._before(ticks, back)[:, self._moving] for back in (1, 2)]
        return np.concatenate([*two, np.ones((len(ticks), 1))], axis=1)

    def _before(self, ticks: Ticks, back: int) -> Values:
        """The action `back` ticks earlier; before the episode's start, what replaces it."""
        absolute = self._store.streams["action"]["kind"] == "absolute"
        start = self._median if absolute else np.zeros_like(self._median)
        first = self._store.array("episode/tick_start")[self._store.episode_of(ticks)]
        action = self._store.array("tick/action")[np.maximum(ticks - back, 0)]
        return np.where((ticks - back < first)[:, None], start, action.astype(np.float64))


class Neighbours:
    """Finds training ticks by their newest state reading and the features of their VL row.

    Angles are compared by sine and cosine. States and features are z-scored; wide features are
    projected at random (Achlioptas 2003), which keeps distances. Both parts are then scaled to the
    same mean square length, so they have equal weight. A tick that lacks a part gets the mean of
    that part, which is zero.
    """

    def __init__(
        self, store: FeatureStore, ticks: Ticks, features: ChannelStatistics | None
    ) -> None:
        self._store, self._ticks, self._statistics = store, ticks, features
        kinds = channel_kinds(store.streams["state"]["names"], store.streams["state"]["units"])
        # Policies see rotations relative to the newest reading: for it, they would always be zero.
        self._kinds: list[Kind] = ["deg" if kind == "rotation" else kind for kind in kinds]
        states, known = self._newest_states(ticks)
        self._scaler = StandardScaler().fit(states[known]) if states[known].size else None
        width = 0 if features is None else features.mean.size
        self._projection = None
        if width > _WIDTH:
            projection = SparseRandomProjection(_WIDTH, random_state=0)  # pyright: ignore[reportArgumentType]
            self._projection = projection.fit(np.zeros((1, width)))
        parts = self._parts(ticks)
        self._lengths = [np.sqrt(np.square(part).sum(axis=1).mean()) or 1.0 for part in parts]
        self._search = NearestNeighbors(n_neighbors=1).fit(self._places(ticks)) if parts else None

    def nearest(self, ticks: Ticks) -> Ticks | None:
        """The training tick nearest to each of these; None in a store without either stream."""
        if self._search is None:
            return None
        nearest = self._search.kneighbors(self._places(ticks), return_distance=False)
        return self._ticks[nearest[:, 0]]

    def _places(self, ticks: Ticks) -> Values:
        parts = zip(self._parts(ticks), self._lengths, strict=True)
        return np.concatenate([part / length for part, length in parts], axis=1)

    def _parts(self, ticks: Ticks) -> list[Values]:
        parts: list[Values] = []
        if self._scaler is not None:
            states, known = self._newest_states(ticks)
            parts.append(np.where(known[:, None], self._scaler.transform(states), 0.0))
        if self._statistics is not None:
            rows, place = np.unique(self._store.array("tick/vl_row")[ticks], return_inverse=True)
            parts.append(np.concatenate(list(self._features(rows, self._statistics)))[place])
        return parts

    def _newest_states(self, ticks: Ticks) -> tuple[Values, NDArray[np.bool_]]:
        """(tick, expanded channel), made of zeros without a reading, and where there is one."""
        values = self._store.array("state/values")
        end = self._store.array("tick/state_end")[ticks]
        known = end > self._store.array("episode/state_start")[self._store.episode_of(ticks)]
        states = np.zeros((len(ticks), values.shape[1]), np.float32)
        states[known] = values[end[known] - 1]
        return expand(torch.from_numpy(states)[:, None], self._kinds)[:, 0].double().numpy(), known

    def _features(self, rows: NDArray[np.int64], statistics: ChannelStatistics) -> Iterator[Values]:
        """The plain features of these VL rows, z-scored and projected, block by block."""
        slots = self._store.feature_shape[0]
        for block in np.split(rows, range(_ROWS, len(rows), _ROWS)):
            values = widen(self._store.array("vl/features")[block][:, :slots])
            valid = self._store.array("vl/slot_valid")[block][:, :slots].astype(bool)
            scaled = (values - statistics.mean) / statistics.scale
            flat = np.where(valid[..., None], scaled, 0.0).reshape(len(block), -1)
            yield flat if self._projection is None else self._projection.transform(flat)


def recorded_chunks(
    store: FeatureStore, ticks: Ticks, horizon: int
) -> tuple[Actions, NDArray[np.bool_]]:
    """Recorded actions (tick, horizon, action_dim), and which lie before the episode's end."""
    end = store.array("episode/tick_start")[store.episode_of(ticks) + 1][:, None]
    ahead = ticks[:, None] + np.arange(horizon)
    return store.array("tick/action")[np.minimum(ahead, end - 1)], ahead < end
