"""The recordings and the store as torch data sets, under the names of the research code."""

from pipeline.compat.batch import Sample, UnifiedBatch, unified_collate_fn
from pipeline.compat.dataset import (
    AsyncInsertionMeca500DatasetWithSensor,
    NewAsyncInsertionDataset,
    UnifiedVLADataset,
)
from pipeline.compat.mixture import MixtureBatches, create_unified_dataloader

async_collate_fn_with_sensor = unified_collate_fn
create_weighted_async_dataloader = create_unified_dataloader

__all__ = [
    "AsyncInsertionMeca500DatasetWithSensor",
    "MixtureBatches",
    "NewAsyncInsertionDataset",
    "Sample",
    "UnifiedBatch",
    "UnifiedVLADataset",
    "async_collate_fn_with_sensor",
    "create_unified_dataloader",
    "create_weighted_async_dataloader",
    "unified_collate_fn",
]
