"""Old and new recordings in one loader, drawn by weight."""

from collections.abc import Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Sampler

from pipeline.base.errors import ConfigError
from pipeline.compat.batch import unified_collate_fn
from pipeline.compat.dataset import UnifiedVLADataset, named_sources
from pipeline.store import FeatureStore
from pipeline.train.sampling import TickSampler


class MixtureBatches(Sampler[list[int]]):
    """The batch sampler of a DataLoader: a batch is a function of (seed, step).

    Each source's share of the draws is its weight (1 unless named), whatever its size, exact to one
    draw. An epoch has as many draws as there are items. An iteration goes from `first_step` to the
    end of its epoch; its first batch moves `first_step` to the next epoch, so an iteration that is
    stopped early is not repeated. To resume a run, set `first_step` to the number of batches that
    it has taken.

    Raises `ConfigError` for a weight that is negative or of an unknown source, if no source has
    both items and weight, and for batches without an item.
    """

    def __init__(
        self,
        by_source: Mapping[str, NDArray[np.int64]],
        weights: Mapping[str, float],
        batch_size: int,
        seed: int,
    ) -> None:
        sizes = {name: len(items) for name, items in by_source.items()}
        foreign = set(weights) - set(sizes) or {w for w in weights.values() if not 0 <= w < inf}
        drawn = [name for name, size in sizes.items() if size and weights.get(name, 1.0)]
        if foreign or not drawn or batch_size < 1:
            raise ConfigError(
                "expected a batch_size from 1, and weights of these sources, finite and from 0, "
                "one that has items above 0; found "
                f"batch_size {batch_size}, items {sizes}, weights {dict(weights)}"
            )
        # TickSampler weighs items: a source's weight is divided by the number of its items.
        of_items = {name: weights.get(name, 1.0) / max(1, size) for name, size in sizes.items()}
        self._sampler = TickSampler(by_source, of_items, batch_size, seed)
        self.steps_per_epoch = -(-sum(sizes.values()) // batch_size)
        self.first_step = 0

    def __len__(self) -> int:
        return self.steps_per_epoch - self.first_step % self.steps_per_epoch

    def __iter__(self) -> Iterator[list[int]]:
        # Moved at the first batch: a DataLoader with workers makes two iterators for an epoch.
        begin = self.first_step
        self.first_step += len(self)
        for step in range(begin, self.first_step):
            yield self.batch(step)

    def batch(self, step: int) -> list[int]:
        """The items of this step."""
        return self._sampler.batch(step).tolist()


def create_unified_dataloader(
    old_dataset_patterns: str | Path | Sequence[str | Path] = (),
    new_dataset_path: str | Path | Sequence[str | Path] | None = None,
    old_weight: float = 1.0,
    new_weight: float = 3.0,
    batch_size: int = 8,
    num_workers: int = 0,
    horizon: int = 8,
    vlm_reuse_count: int = 3,
    sensor_window_size: int = 65,
    *,
    store: FeatureStore | str | Path | None = None,
    seed: int = 0,
    val_fraction: float = 0.0,
    pin_memory: bool = False,
    **settings: Any,
) -> DataLoader[Any]:
    """A loader of `UnifiedBatch`es that draws three new items for each old one.

    `old_weight` and `new_weight` are shares of the draws, whatever the sizes. `train_head.mixture`
    is different: it weighs each tick, so a source's share is its weight times its ticks.

    `settings` go to the `UnifiedVLADataset`, the loader's `dataset`. `val_fraction` of its episodes
    are never drawn: `loader.dataset.split(val_fraction)[1]` has them. The loader's `batch_sampler`
    is the `MixtureBatches` that resumes a run. With only a `store`, episodes are old by their
    format, all others new. Raises as these classes do.
    """
    old = named_sources(old_dataset_patterns, "old")
    sources = [*old, *named_sources(new_dataset_path or (), "new")]
    dataset = UnifiedVLADataset(
        sources,
        horizon=horizon,
        vlm_reuse_count=vlm_reuse_count,
        sensor_window_size=sensor_window_size,
        store=store,
        **settings,
    )
    drawn = dataset.split(val_fraction)[0].indices if val_fraction else range(len(dataset))
    items = {
        name: of_name[np.isin(of_name, np.array(drawn))]
        for name, of_name in dataset.items_by("source" if sources else "format").items()
    }
    weights = {name: old_weight if name == "old" else new_weight for name in items}
    batches = MixtureBatches(items, weights, batch_size, seed)
    return DataLoader(
        dataset,
        batch_sampler=batches,
        num_workers=num_workers,
        collate_fn=unified_collate_fn,
        pin_memory=pin_memory,
        persistent_workers=bool(num_workers),
    )
