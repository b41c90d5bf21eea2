"""Several samples of a policy: their mean, the best of them, their energy score."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.distance import cdist, pdist

from pipeline.train.predictions import Actions

MEAN, BEST = "mean of n", "best of n"
ENERGY = "energy score"


class SampledChunks:
    """Collects the samples of a policy batch by batch; the `watch` of `predict`.

    `scale` (action_dim,) is that of `Comparison`: a dimension that does not vary in training has no
    weight.
    """

    def __init__(self, scale: Float[np.ndarray, " action_dim"]) -> None:
        counted = scale > 0 if (scale > 0).any() else np.ones_like(scale, np.bool_)
        self._per_std = np.where(counted, 1 / np.where(scale > 0, scale, 1), 0.0)
        self._mean: list[Actions] = []
        self._best: list[Actions] = []
        self._energy: list[Float[np.ndarray, " tick"]] = []

    def __call__(
        self,
        chunks: Float[np.ndarray, "sample tick horizon action_dim"],
        recorded: Float[np.ndarray, "tick horizon action_dim"],
        valid: Bool[np.ndarray, "tick horizon"],
    ) -> None:
        if len(chunks) < 2:
            return
        self._mean.append(chunks.mean(axis=0))
        errors = np.abs(chunks - recorded) @ self._per_std
        best = np.where(valid, errors, 0.0).sum(axis=2).argmin(axis=0)
        self._best.append(chunks[best, np.arange(len(best))])
        pairs = zip(chunks.swapaxes(0, 1), recorded, valid, strict=True)
        self._energy.append(np.array([self._score(*pair) for pair in pairs]))

    def chunks(self) -> dict[str, Actions]:
        """The mean and the best of the samples, (tick, horizon, action_dim); empty with one sample.

        The best has the lowest error over the valid entries. Only the recorded actions tell which
        one it is, so it shows what the samples contain, not what a robot would do.
        """
        ways = {MEAN: self._mean, BEST: self._best}
        return {name: np.concatenate(parts) for name, parts in ways.items() if parts}

    def energy(self) -> Float[np.ndarray, " tick"]:
        """The energy score of each tick's samples; empty with one sample.

        Gneiting and Raftery (2007), eq. 21 with beta 1, negated so that lower is better: the mean
        distance to the recorded chunk, minus half the mean distance between two different samples.
        A distance is Euclidean over the valid entries of the chunk in training std, divided by the
        square root of their number: for a single sample, its root mean square error.
        """
        return np.concatenate(self._energy) if self._energy else np.empty(0)

    def _score(
        self,
        chunks: Float[np.ndarray, "sample horizon action_dim"],
        recorded: Float[np.ndarray, "horizon action_dim"],
        valid: Bool[np.ndarray, " horizon"],
    ) -> float:
        # Dimensions without weight are zero in all samples and add to no distance.
        samples = (chunks[:, valid] * self._per_std).reshape(len(chunks), -1)
        truth = (recorded[valid] * self._per_std).reshape(1, -1)
        distance = cdist(samples, truth).mean() - pdist(samples).mean() / 2
        return float(distance / np.sqrt(valid.sum() * np.count_nonzero(self._per_std)))
