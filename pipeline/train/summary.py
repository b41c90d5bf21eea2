"""What a run trains, from what, and what it took, in words."""

import numpy as np
import torch

from pipeline.base.config import TrainHeadParams
from pipeline.base.format import duration, size
from pipeline.policy.cost import describe_cost
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Policy
from pipeline.store import FeatureStore
from pipeline.train.judging import EarlyStopping
from pipeline.train.learner import Learner
from pipeline.train.mixture import ticks_by_source
from pipeline.train.speed import peak_memory_bytes
from pipeline.train.split import Split


def describe_data(
    store: FeatureStore, shape: PolicyShape, params: TrainHeadParams, split: Split
) -> list[str]:
    """Lines on the store, its streams that are there, absent or disabled, and the split."""
    slots, dim = store.feature_shape
    lines = [
        f"store {store.path}: {len(store.episodes)} episodes, {store.ticks} ticks, "
        f"{slots} x {dim} features a VL row",
        f"split: {len(split.train)} training ticks, {len(split.held_out)} held out "
        f"of {len(split.held_out_episodes)} episode(s)",
    ]
    if split.note:
        lines.append(f"split: {split.note}")
    for stream, (stored, _, switch) in _streams(store, shape).items():
        if not stored:
            lines.append(f"{stream}: absent from the store, its encoder is disabled")
        elif not getattr(params, switch):
            lines.append(f"{stream}: disabled by train_head.{switch}")
    return lines


def data_warnings(
    store: FeatureStore, shape: PolicyShape, params: TrainHeadParams, split: Split
) -> list[str]:
    """Lines on what the store has and the training episodes have not: a source, a stream."""
    trained, whole = (
        ticks_by_source(store, ticks) for ticks in (split.train, np.arange(store.ticks))
    )
    lost = [
        f"source {source!r}: all of its episodes are held out. The policy is judged on them and "
        "learns nothing from them"
        for source, ticks in whole.items()
        if len(ticks) and not len(trained[source]) and params.mixture.get(source, 1) > 0
    ]
    lost += [
        f"{stream}: in the store, but absent from the training episodes. The policy learns without "
        "it"
        for stream, (stored, known, switch) in _streams(store, shape).items()
        if stored and not known and getattr(params, switch)
    ]
    return [
        f"warning: {what}. Episodes are held out by the hash of their names, "
        f"train_head.val_fraction {params.val_fraction:g} of them: set a smaller one (0 holds none "
        "out), or extract more episodes with it"
        for what in lost
    ]


def _streams(store: FeatureStore, shape: PolicyShape) -> dict[str, tuple[int, int, str]]:
    """Of each stream its width in the store and in training, and the key that disables it."""
    slots, dim = store.feature_shape
    return {
        "sensor": (store.sensor_channels, shape.sensor_channels, "sensor_enabled"),
        "state": (store.state_dim, shape.state_dim, "robot_state_enabled"),
        "features": (slots * dim, slots * dim, "features_enabled"),
    }


def describe_learner(learner: Learner, policy: Policy) -> list[str]:
    """Lines on what the policy's parts cost, and on what else is trained or stays frozen."""
    lines = describe_cost(policy)
    if learner.module is not policy:
        table = ", ".join(f"{part} {n:,}" for part, n in learner.trained.parameter_table())
        lines.append(f"parameters with what is before it: {table}")
    learning = sum(value.numel() for value in learner.learning.values())
    whole = sum(value.numel() for value in learner.module.parameters())
    if learning < whole:
        lines.append(f"learns {learning:,} of {whole:,} parameters")
    return lines


def closing(
    step: int, standing: EarlyStopping, trained_s: float, device: torch.device
) -> list[str]:
    """Lines on what a run took: its steps, `trained_s` seconds of them, and this process's memory.

    Evaluations and checkpoints are not in the seconds.
    """
    early = f"stopped early at step {step}: {standing.stalled} evaluations without a better one"
    return [
        *([early] if standing.exhausted else []),
        f"trained {step} steps in {duration(trained_s)} "
        f"({step / max(trained_s, 1e-9):.1f} steps/s), "
        f"peak memory {size(peak_memory_bytes(device))}",
    ]
