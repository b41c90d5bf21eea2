"""What decides the numbers of a training run: only a run of the same goes on."""

import hashlib
import json
import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pipeline.base.config import TrainHeadParams
from pipeline.policy.checkpoint import SOURCE_KEYS
from pipeline.policy.normalization import Normalization
from pipeline.store import FeatureStore

if TYPE_CHECKING:
    from pipeline.policy.observation import PolicyShape

TRAINER_VERSION = 3
"""Raised with every change of code that changes the numbers of a run: part of its identity, so
that no run goes on under code other than it began with."""
FREE_PARAMS = {
    "device",
    "feed",
    "check_store",
    "output",
    "logs",
    "loggers",
    "wandb_project",
    "checkpoint_every",
    "store",
    "grad_accumulation",
}
"""Params that may change between a stop and the next start: they decide no number of the run, or
not alone: `parts`, accumulation times processes, stands for the last."""

NOTHING: Mapping[str, Any] = MappingProxyType({})


def run_identity(
    params: TrainHeadParams, store: FeatureStore, extra_identity: Mapping[str, Any] = NOTHING
) -> dict[str, Any]:
    """Everything that decides the numbers of a run, as JSON."""
    decides = {
        "trainer_version": TRAINER_VERSION,
        "train_head": params.model_dump(mode="json", exclude=FREE_PARAMS),
        "parts": _processes() * params.grad_accumulation,
        "front": dict(extra_identity),
        "recordings": recordings_of(store),
    }
    return json.loads(json.dumps({"source": source_of(store), "decides": decides}))


def _processes() -> int:
    """How many train together; torch is asked only where torchrun says that there are several."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return 1
    from pipeline.train.world import World

    return World.current().size


def recordings_of(store: FeatureStore) -> dict[str, Any]:
    """Which episodes and rows a store holds, as a run remembers it."""
    episodes = [[e.source, e.id, e.digest, len(e.ticks)] for e in store.episodes]
    digest = hashlib.blake2b(json.dumps(episodes).encode(), digest_size=16)
    digest.update(store.array("vl/key").tobytes())
    return {
        "episodes": len(store.episodes),
        "ticks": store.ticks,
        "digest": digest.hexdigest(),
    }


def source_of(store: FeatureStore) -> dict[str, Any]:
    """What a checkpoint remembers of its store, and what another store must agree with."""
    return {key: getattr(store, "spec" if key == "feature_spec" else key) for key in SOURCE_KEYS}


def policy_shape(store: FeatureStore, normalization: Normalization) -> "PolicyShape":
    """The widths that this store gives to a policy.

    A stream without statistics is absent from what the policy is trained on, so it has width 0.
    """
    from pipeline.policy.observation import PolicyShape, action_groups

    action = store.streams["action"]
    return PolicyShape(
        *store.feature_shape,
        sensor_channels=store.sensor_channels if normalization.sensor else 0,
        state_dim=store.state_dim if normalization.state else 0,
        action_dim=store.action_dim,
        action_groups=action_groups(action["names"], action["units"]),
    )
