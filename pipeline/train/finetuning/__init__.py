"""Tuning the vision-language model end to end, below the policy that `train_head` describes.

`recordings` finds the frames of a store's rows, `rows` decodes them and puts them beside the
store's batches, `feature_source` stands before the policy in the one training loop.
"""

from pipeline.train.finetuning.feature_source import (
    ModelFeatureSource,
    head_params,
    next_steps,
    out_of_memory_named,
)

__all__ = ["ModelFeatureSource", "head_params", "next_steps", "out_of_memory_named"]
