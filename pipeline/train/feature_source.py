"""Where a training's features come from: the seam between one loop and its two ways."""

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from pipeline.base.golden import GoldenRow
from pipeline.policy.policy import Policy, Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, DeviceStore, Prefetch, Windows


class FeatureSource:
    """What stands before a policy in training: nothing, as here, or a model that still learns.

    Here features come from the store, and the policy is all that is trained, kept and saved. The
    wide fields of a batch that `on_device` names live on the device that is fed; they are copied to
    it when the first batches are asked for, once for all feeds.
    """

    identity: Mapping[str, Any] = {}
    """JSON: what else decides the numbers of the run; empty where the params say it all."""
    eval_ticks: int | None = None
    """Ticks of val evaluated at most during training; None: the trainer's own limit."""

    def __init__(self, store: FeatureStore, on_device: Collection[str] = (), *notes: str) -> None:
        self.store = store
        self.notes = notes
        """What to say of it, as lines for the user."""
        self._on_device = on_device
        self._resident: DeviceStore | None = None

    @property
    def golden(self) -> tuple[GoldenRow, ...]:
        """What a checkpoint carries to prove a live model by: the store's golden rows.

        Raises `StoreIncomplete` where one is damaged.
        """
        return self.store.golden

    def attach(self, policy: Policy) -> Trainable:
        """The module that is trained; it holds the policy."""
        return policy

    def policy_of(self, module: Trainable) -> Policy:
        """The policy within a module of `attach`, or within a copy of one."""
        assert isinstance(module, Policy)
        return module

    def parameter_lr(self, name: str) -> float | None:
        """Peak learning rate of a parameter by its name in the module; None: `train_head`'s."""
        return None

    def feed(
        self, plan: Iterable[BatchIndices], windows: Windows, device: torch.device
    ) -> Prefetch:
        """The batches of a plan, in its order, as the module takes them."""
        if self._on_device and self._resident is None:
            self._resident = DeviceStore(self.store, self._on_device, device)
        return Prefetch(self.store, plan, windows, device, resident=self._resident)

    def save(self, folder: Path, module: Trainable) -> None:
        """Write what a checkpoint folder holds beside the policy's files."""
