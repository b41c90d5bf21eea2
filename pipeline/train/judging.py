"""How good the averaged weights are while a run goes, and when it has stopped getting better."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from torch import nn

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.policy.normalization import Normalization
from pipeline.policy.policy import Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.feature_source import FeatureSource
from pipeline.train.held_out import judge
from pipeline.train.split import Split

EVALUATION_TICKS = 1000
"""Held-out ticks judged during training at most, evenly spaced; `stages.evaluate` takes all."""


@dataclass
class EarlyStopping:
    """The best held-out error so far and how many evaluations have come since."""

    patience: int | None
    """Evaluations without a better one after which a run ends; None never ends it."""
    best_error: float | None = None
    stalled: int = 0

    @classmethod
    def of(cls, params: TrainHeadParams, split: Split) -> Self:
        """That of a run which begins.

        Raises `ConfigError` where it is to stop early and nothing tells when.
        """
        if params.early_stopping is not None and not len(split.held_out):
            raise ConfigError(
                f"train_head.early_stopping is {params.early_stopping}, but nothing is held out "
                f"that could stop getting better: train_head.val_fraction is "
                f"{params.val_fraction:g}. Set it above 0, or train_head.early_stopping=null."
            )
        return cls(params.early_stopping)

    def improves(self, error: float) -> bool:
        """Whether an error is below all before it."""
        return self.best_error is None or error < self.best_error

    def take(self, error: float) -> bool:
        """Take in the error of an evaluation; whether it is the best so far."""
        better = self.improves(error)
        if better:
            self.best_error = error
        self.stalled = 0 if better else self.stalled + 1
        return better

    @property
    def exhausted(self) -> bool:
        """Whether the run ends here."""
        return self.patience is not None and self.stalled >= self.patience


def judged_ticks(held_out: NDArray[np.int64], front: FeatureSource) -> NDArray[np.int64]:
    """The held-out ticks that evaluations of a run look at: as many as it may, evenly spaced."""
    limit = EVALUATION_TICKS if front.eval_ticks is None else front.eval_ticks
    spread = np.linspace(0, len(held_out) - 1, min(len(held_out), limit)).round()
    return held_out[spread.astype(np.int64)]


def held_out_error(
    module: nn.Module,
    front: FeatureSource,
    store: FeatureStore,
    ticks: NDArray[np.int64],
    params: TrainHeadParams,
    normalization: Normalization,
) -> dict[str, float]:
    """`val/error`, in training standard deviations, and `val/<group>` in the group's unit.

    Raises `NumericsError` as `judge` does.
    """
    assert isinstance(module, Trainable)
    windows = Windows.of(params)
    device = next(module.parameters()).device
    comparison, _ = judge(
        module,
        store,
        ticks,
        windows,
        params.batch_size,
        normalization,
        samples=params.eval_samples,
        feed=lambda plan: front.feed(plan, windows, device),
    )
    groups = {
        f"val/{group.key}": comparison.group_mae("policy", group) for group in comparison.groups
    }
    return {"val/error": comparison.overall("policy"), **groups}
