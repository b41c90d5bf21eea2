"""A run does not depend on how its batches reach it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.store import FeatureStore
from pipeline.train.loop import Trainer

Make = Callable[..., Any]


def stopped_after(steps: int, trainer: Trainer) -> None:
    """Run `trainer` until a checkpoint after that many steps, as a SIGTERM would end it."""
    real = trainer._save_last

    def save_and_stop(*rest: Any) -> None:
        real(*rest)
        if trainer.step >= steps:
            raise KeyboardInterrupt

    trainer._save_last = save_and_stop  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        trainer.fit()


def weights(trainer: Trainer) -> list[torch.Tensor]:
    return [*trainer.policy.state_dict().values(), *trainer.averaged.state_dict().values()]


@pytest.mark.parametrize(("first", "then"), [("mapped", "device"), ("device", "mapped")])
def test_another_feed_continues_bit_for_bit(
    store: FeatureStore, params: Make, trainer: Make, tmp_path: Path, first: str, then: str
) -> None:
    whole = trainer(store, params(feed="mapped", output=tmp_path / "whole"))
    whole.fit()
    stopped_after(10, trainer(store, params(feed=first)))
    again = trainer(store, params(feed=then))
    assert again.run.status == "resumed"
    assert again.step == 10
    again.fit()
    for found, expected in zip(weights(again), weights(whole), strict=True):
        assert torch.equal(found, expected)


def test_the_summary_says_which_and_why(store: FeatureStore, params: Make, trainer: Make) -> None:
    assert "feed: mapped (auto: training runs on the cpu)" in trainer(store, params()).summary()
    lines = trainer(store, params(feed="device")).summary()
    assert any(line.startswith("feed: device (as train_head.feed says;") for line in lines)
