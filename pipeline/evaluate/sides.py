"""What a baseline is fitted on, and which groups the test ticks are of."""

import numpy as np
from numpy.typing import NDArray

from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.store import FeatureStore, episode_name
from pipeline.train.batches import Ticks
from pipeline.train.split import episodes_by_recording, find_held_out


def training_ticks(store: FeatureStore, checkpoint: PolicyCheckpoint) -> Ticks:
    """All ticks of the store that the checkpoint does not hold out."""
    held_out, _ = find_held_out(store, checkpoint)
    return np.setdiff1d(np.arange(store.ticks), held_out)


def groups_of(store: FeatureStore, checkpoint: PolicyCheckpoint, ticks: Ticks) -> NDArray[np.str_]:
    """(tick,) the name of the group of recordings that each tick's episode is of."""
    named = {
        episode_name(episode): name
        for name, episodes in episodes_by_recording(store).items()
        for episode in episodes
    }
    return np.array([named[episode_name(store.episodes[i])] for i in store.episode_of(ticks)])
