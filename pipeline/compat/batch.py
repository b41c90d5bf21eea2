"""The samples and batches of a data set, and how samples become a batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float64, Int64, UInt8
from torch import Tensor

from pipeline.base.errors import StoreMismatch
from pipeline.data.episode import Frames
from pipeline.store import Batch

Sample = Mapping[str, Any]
"""One tick: the fields of `UnifiedBatch` by name, without their batch axis."""


@dataclass
class UnifiedBatch(Batch):
    """The store's batch with the time, episode and instruction of each tick.

    With a store it has features and their `key`; without one it has `images`, and features have no
    slots. It is an `Observation`: `policy.loss(batch, batch.action, batch.action_valid)` takes it,
    and `QwenVLAUnified` takes its `inputs()`.
    """

    tick: Int64[Tensor, " batch"]
    """Index into `UnifiedVLADataset.store`."""
    time: Float64[Tensor, " batch"]
    """Seconds on the episode's clock."""
    episode: Int64[Tensor, " batch"]
    """Index into `UnifiedVLADataset.store.episodes`."""
    vl_row: Int64[Tensor, " batch"]
    """Equal for ticks that see the same frames."""
    instruction: list[str]
    images: list[Frames] | None = None
    """Frames of each sample, without views that its episode lacks; equal VL rows share arrays."""
    key: UInt8[Tensor, "batch 16"] | None = None
    """Digest of the features' spec, prompt and frames."""

    def __getitem__(self, index: int) -> Sample:
        if not -len(self) <= index < len(self):
            raise IndexError(f"a batch of {len(self)} samples has no sample {index}")
        return {
            name: value if value is None else value[index] for name, value in vars(self).items()
        }

    def inputs(self) -> dict[str, Any]:
        """The keyword arguments with which `QwenVLAUnified.forward` gives the loss."""
        streams = ("feature_age", "sensor", "sensor_valid", "state", "state_valid", "action_valid")
        arguments = {name: getattr(self, name) for name in streams} | {"actions": self.action}
        if self.images is not None:
            return arguments | {"images": self.images, "text": self.instruction}
        return arguments | {"features": self.features, "slot_valid": self.slot_valid}

    pin_memory = Batch.pin
    """`DataLoader(pin_memory=True)` calls this."""


def unified_collate_fn(samples: Sequence[Sample] | UnifiedBatch) -> UnifiedBatch:
    """The batch of these samples of one data set; a batch stays as it is.

    Windows already have one length: `*_valid` says how much of each is real. Raises `StoreMismatch`
    if some samples have features and others have frames.
    """
    if isinstance(samples, UnifiedBatch):
        return samples
    cached = sum(sample["images"] is None for sample in samples)
    if cached not in (0, len(samples)):
        raise StoreMismatch(
            f"a batch has features or frames, but {cached} of its {len(samples)} samples have "
            "features of a store. Give all data sets a store, or none"
        )
    return UnifiedBatch(
        **{f.name: _stack([sample[f.name] for sample in samples]) for f in fields(UnifiedBatch)}
    )


def _stack(values: list[Any]) -> Any:
    if values[0] is None:
        return None
    return torch.stack(values) if isinstance(values[0], Tensor) else values
