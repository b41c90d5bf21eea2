"""The recordings and the store as torch data sets: doors for people who come from the old code.

`unified` finds the episodes and hands out batches, `streams` lays recordings out in memory as a
store without features, `frames` decodes what a tick sees, `batch` is what comes out, `mixture`
draws old and new recordings in one loader. Windows, ticks and shares are those of `store`,
`timeline` and `sampling`; nothing is cut or drawn a second way here.
"""

from pipeline.datasets.batch import Sample, UnifiedBatch, unified_collate_fn
from pipeline.datasets.mixture import MixtureBatches, create_unified_dataloader
from pipeline.datasets.unified import (
    AsyncInsertionMeca500DatasetWithSensor,
    NewAsyncInsertionDataset,
    UnifiedVLADataset,
)

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
