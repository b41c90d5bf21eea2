"""Tuning the vision-language model end to end, with the policy that `train_head` describes.

`recordings` opens the recordings of a store, `rows` decodes the frames of its rows beside its
batches, `feature_source` puts the model before the policy in the one training loop.
"""

from pipeline.train.finetuning.feature_source import (
    ModelFeatureSource,
    head_params,
    next_steps,
    out_of_memory_named,
)

__all__ = ["ModelFeatureSource", "head_params", "next_steps", "out_of_memory_named"]
