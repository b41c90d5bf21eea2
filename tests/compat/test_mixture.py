"""Old and new in one loader: shares to one draw, resumable, a function of (seed, step)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.datasets import (
    MixtureBatches,
    UnifiedBatch,
    create_unified_dataloader,
    create_weighted_async_dataloader,
)


def batches(sizes: dict[str, int], **weights: float) -> MixtureBatches:
    edges = np.cumsum([0, *sizes.values()])
    items = {
        name: np.arange(start, stop)
        for name, start, stop in zip(sizes, edges, edges[1:], strict=False)
    }
    return MixtureBatches(items, weights, batch_size=7, seed=3)


class TestShares:
    def test_what_cannot_be_drawn_is_refused_in_the_words_of_the_caller(self) -> None:
        items = {"old": np.arange(3), "new": np.arange(3, 9)}
        for weights, batch_size, message in (
            ({"old": -1.0}, 7, r"weights \{'old': -1\.0\}"),
            ({"older": 1.0}, 7, r"items \{'old': 3, 'new': 6\}, weights \{'older'"),
            ({}, 0, "batch_size from 1.*found batch_size 0"),
        ):
            with pytest.raises(ConfigError, match=message) as refused:
                MixtureBatches(items, weights, batch_size, seed=0)
            assert "train_head" not in str(refused.value)


class TestResume:
    def test_from_every_step_of_three_epochs(self):
        whole = batches({"old": 20, "new": 30})
        epochs = [list(whole) for _ in range(3)]
        assert [len(epoch) for epoch in epochs] == [8, 8, 8]
        taken = [batch for epoch in epochs for batch in epoch]
        for step in range(len(taken)):
            resumed = batches({"old": 20, "new": 30})
            resumed.first_step = step
            assert len(resumed) == 8 - step % 8
            rest = list(resumed)
            assert rest == taken[step : step + len(rest)]
            assert resumed.first_step == (step // 8 + 1) * 8

    def test_an_epoch_that_is_broken_off_is_not_repeated(self):
        drawn = batches({"old": 20, "new": 30})
        whole = [drawn.batch(step) for step in range(16)]
        started = iter(drawn)
        assert [next(started), next(started)] == whole[:2]
        assert drawn.first_step == 8
        assert list(drawn) == whole[8:16]
        drawn.first_step = 2  # resumed where it was broken off
        assert list(drawn) == whole[2:8]


@pytest.fixture(scope="module")
def loader(recordings: Path) -> Any:
    return create_unified_dataloader(recordings / "old", [recordings / "new"], batch_size=12)


class TestLoader:
    def test_draws_old_and_new_recordings_1_to_3(self, loader: Any) -> None:
        formats = [episode.format for episode in loader.dataset.store.episodes]
        for _, batch in zip(range(4), loader, strict=False):
            assert isinstance(batch, UnifiedBatch) and batch.images is not None
            drawn = [formats[episode] for episode in batch.episode.tolist()]
            assert (drawn.count("old"), drawn.count("new")) == (3, 9)

    def test_gives_the_same_ticks_with_features_and_in_workers(self, recordings, extracted, loader):
        cached = create_weighted_async_dataloader(
            recordings / "old", recordings / "new", batch_size=12, num_workers=1, store=extracted
        )
        batch = next(iter(cached))
        items = loader.batch_sampler.batch(0)
        assert torch.equal(batch.action, loader.dataset.__getitems__(items).action)
        assert batch.features.shape[1:] == extracted.feature_shape

    def test_held_out_episodes_are_never_drawn(self, recordings: Path) -> None:
        loader = create_unified_dataloader(
            recordings / "old", recordings / "new", batch_size=16, val_fraction=0.3
        )
        held_out = set(loader.dataset.split(0.3)[1].indices)
        steps = range(2 * len(loader))
        assert held_out
        assert not held_out & {item for step in steps for item in loader.batch_sampler.batch(step)}

    def test_one_side_alone_is_a_mixture_of_one(self, recordings: Path) -> None:
        loader = create_unified_dataloader(new_dataset_path=recordings / "new", batch_size=4)
        assert len(next(iter(loader))) == 4
