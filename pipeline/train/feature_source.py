"""Where training gets its features: from the store, or from a model that learns."""

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from pipeline.base.source import GoldenRow
from pipeline.policy.policy import Policy, Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, DeviceStore, Prefetch, Windows


class FeatureSource:
    """Features from the store; only the policy is trained and saved.

    A subclass puts a model before the policy. The wide fields that `on_device` names are kept on
    the device; the first feed copies them there, once for all feeds.
    """

    identity: Mapping[str, Any] = {}
    """JSON of everything besides store and params that decides the run's numbers; may be empty."""
    eval_ticks: int | None = None
    """The most val ticks of an evaluation during training; None: the trainer's own limit."""

    def __init__(self, store: FeatureStore, on_device: Collection[str] = (), *notes: str) -> None:
        self.store = store
        self.notes = notes
        """Lines for the user."""
        self._on_device = on_device
        self._resident: DeviceStore | None = None

    @property
    def golden(self) -> tuple[GoldenRow, ...]:
        """The store's golden rows: a live model is checked against their features.

        Raises `StoreIncomplete` where one is damaged.
        """
        return self.store.golden

    def attach(self, policy: Policy) -> Trainable:
        """The module that is trained; it holds the policy."""
        return policy

    def policy_of(self, module: Trainable) -> Policy:
        """The policy inside a module that `attach` returned, or inside a copy of it."""
        assert isinstance(module, Policy)
        return module

    def parameter_lr(self, name: str) -> float | None:
        """The peak learning rate of a parameter of the module; None: the rate of `train_head`."""
        return None

    def feed(
        self, plan: Iterable[BatchIndices], windows: Windows, device: torch.device
    ) -> Prefetch:
        """The batches of a plan, in its order, in the form that the module takes."""
        if self._on_device and self._resident is None:
            self._resident = DeviceStore(self.store, self._on_device, device)
        return Prefetch(self.store, plan, windows, device, resident=self._resident)

    def save(self, folder: Path, module: Trainable) -> None:
        """Write further files beside the policy's in a checkpoint folder; here there are none."""
