"""The inputs over which an exported head is compared with its policy."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.base.observation import Observation
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.observation import AGES, VALIDITY
from pipeline.policy.policy import Policy

Inputs = dict[str, Tensor]
"""Tensors of the fields of `Observation` that a policy looks at, in their order, and `noise`."""

ROWS = 16
_OLD_S = 30.0
"""Age of the oldest features among the random inputs."""
_TURN = {"deg": 5.0, "rad": 0.1, "rotation": 5.0}
"""Standard deviation of the random angles, by kind, in the kind's unit."""


def golden_inputs(checkpoint: PolicyCheckpoint, policy: Policy) -> dict[str, Inputs]:
    """`random` inputs and, where the checkpoint has golden rows, `golden` ones."""
    given = {"random": random_inputs(checkpoint, policy, ROWS)}
    rows = checkpoint.golden
    if rows and "features" in policy.encoders:
        golden = random_inputs(checkpoint, policy, len(rows), seed=1)
        golden["features"] = torch.from_numpy(np.stack([row.features for row in rows])).float()
        golden["slot_valid"] = torch.from_numpy(np.stack([row.slot_valid for row in rows])).bool()
        given["golden"] = golden
    return given


def random_inputs(checkpoint: PolicyCheckpoint, policy: Policy, rows: int, seed: int = 0) -> Inputs:
    """Random observations around the training mean, on the CPU, and the noise for them.

    Some windows are full, others half full, of one reading or empty; some features are old, some
    slots and views are missing.
    """
    rng = np.random.default_rng(seed)
    given: dict[str, NDArray[Any]] = {}
    for stream in policy.encoders:
        given[stream] = values = _drawn(checkpoint, stream, rows, rng)
        count = rng.choice([0, 1, values.shape[1] // 2, values.shape[1]], rows)
        given[VALIDITY[stream]] = count
        if stream in AGES:
            reach_s: float = getattr(checkpoint.params, f"{stream}_window_s") or 1.0
            age_s = -np.sort(-rng.uniform(0, reach_s, values.shape[:2]))  # the newest last
            seen = np.arange(values.shape[1]) >= values.shape[1] - count[:, None]
            given[AGES[stream]] = np.where(seen, age_s, 0)
    if "features" in given:
        given["slot_valid"] = rng.uniform(size=given["features"].shape[:2]) < rng.choice(
            [0, 0.5, 1], (rows, 1)
        )
        age_s = rng.uniform(0, _OLD_S, (rows, max(1, policy.shape.views)))
        given["feature_age"] = age_s.min(axis=1)
        unseen = rng.uniform(size=age_s.shape) < 0.2
        given["view_age"] = np.where(unseen, np.nan, age_s)[:, : policy.shape.views]
    order = [name for name in Observation.__dataclass_fields__ if name in given]
    tensors = {name: torch.from_numpy(given[name]) for name in order}
    if draws := count_draws(policy, tensors):
        tensors["noise"] = torch.from_numpy(rng.normal(size=(rows, draws, *chunk_size(policy))))
    return {name: v.float() if v.is_floating_point() else v for name, v in tensors.items()}


def count_draws(policy: Policy, given: Inputs) -> int:
    """How often the policy draws noise in one call of `act`."""
    draws: list[Tensor] = []
    rows = len(next(iter(given.values())))

    def source() -> Iterator[Tensor]:
        while True:
            draws.append(torch.zeros(rows, *chunk_size(policy)))
            yield draws[-1]

    policy.act(cast(Observation, SimpleNamespace(**given)), source())
    return len(draws)


def chunk_size(built: PolicyCheckpoint | Policy) -> tuple[int, int]:
    """The steps and channels of an action chunk."""
    return built.params.horizon, built.shape.action_dim


def _drawn(
    checkpoint: PolicyCheckpoint, stream: str, rows: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Random values (row, slot or reading, channel) of a stream around its training mean."""
    statistics, shape = getattr(checkpoint.normalization, stream), checkpoint.shape
    lengths = {"sensor": checkpoint.params.sensor_window, "state": checkpoint.params.state_readings}
    spread = statistics.std
    if stream == "state":
        plain = iter(spread)  # expanded states begin with the plain channels
        spread = np.array([_TURN.get(kind) or next(plain) for kind in shape.kinds])
    mean = checkpoint.typical(stream)
    size = mean.shape if stream == "features" else (lengths[stream], *mean.shape)
    return mean + spread * rng.standard_normal((rows, *size))
