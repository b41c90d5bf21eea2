"""What a run trains, from what, and what it took, in words."""

import torch

from pipeline.amounts import duration, size
from pipeline.config import TrainHeadParams
from pipeline.models import Policy, PolicyShape
from pipeline.models.cost import describe_cost
from pipeline.sampling import Split
from pipeline.store import FeatureStore
from pipeline.training.judging import Standing
from pipeline.training.learner import Learner
from pipeline.training.speed import peak_memory_bytes


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
    streams = {
        "sensor": (store.sensor_channels, shape.sensor_channels, "sensor_enabled"),
        "state": (store.state_dim, shape.state_dim, "robot_state_enabled"),
        "features": (slots * dim, slots * dim, "features_enabled"),
    }
    for stream, (stored, trained, switch) in streams.items():
        if not trained:
            lacking = "the training episodes" if stored else "the store"
            lines.append(f"{stream}: absent from {lacking}, its encoder is disabled")
        elif not getattr(params, switch):
            lines.append(f"{stream}: disabled by train_head.{switch}")
    return lines


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


def closing(step: int, standing: Standing, trained_s: float, device: torch.device) -> list[str]:
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
