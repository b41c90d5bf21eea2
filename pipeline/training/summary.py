"""What a run trains from, in words."""

from pipeline.config import TrainHeadParams
from pipeline.models import PolicyShape
from pipeline.sampling import Split
from pipeline.store import FeatureStore


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
        "sensor": (
            store.sensor_channels,
            shape.sensor_channels,
            params.sensor_enabled,
            "sensor_enabled",
        ),
        "state": (
            store.state_dim,
            shape.state_dim,
            params.robot_state_enabled,
            "robot_state_enabled",
        ),
        "features": (slots * dim, slots * dim, params.features_enabled, "features_enabled"),
    }
    for stream, (stored, trained, enabled, param) in streams.items():
        if not trained:
            lacking = "the training episodes" if stored else "the store"
            lines.append(f"{stream}: absent from {lacking}, its encoder is disabled")
        elif not enabled:
            lines.append(f"{stream}: disabled by train_head.{param}")
    return lines
