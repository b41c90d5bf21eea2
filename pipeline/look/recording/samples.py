"""Training samples of one recording, exactly as training sees them."""

import numpy as np

from pipeline.base.config import Params
from pipeline.compat.batch import UnifiedBatch, unified_collate_fn
from pipeline.compat.dataset import UnifiedVLADataset
from pipeline.look.recording.facts import EpisodeView


def samples(
    view: EpisodeView, params: Params, count: int, seed: int
) -> tuple[UnifiedVLADataset, UnifiedBatch]:
    """The data set of this recording alone, and at most `count` different samples as one batch.

    In order of time: the first is the episode's first tick, whose windows begin with padding, the
    last its last, whose chunk is masked past the end; those between are drawn by `seed`. Windows
    and horizon are those of `train_head`. Raises `RecordingError` where the recording cannot be
    read.
    """
    data, head = params.data, params.train_head
    dataset = UnifiedVLADataset(
        recordings=[view.recording],
        horizon=head.horizon,
        vlm_reuse_count=data.vlm_reuse_count,
        sensor_window_size=head.sensor_window,
        state_window_size=head.state_window,
        action_hz=data.action_hz,
        action_rotation=view.action_rotation,
    )
    ticks = len(dataset)
    ends = np.unique([0, ticks - 1])[:count]
    inner = np.random.default_rng(seed).permutation(np.arange(1, ticks - 1))
    items = np.sort(np.concatenate([ends, inner[: max(0, count - len(ends))]]))
    batch = unified_collate_fn(dataset.__getitems__(items.tolist()))
    return dataset, batch
