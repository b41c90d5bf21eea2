"""Live features of a policy, and the proof that they come from the model it was trained on.

The feature specs are compared before a weight is loaded. The golden rows show what no spec shows:
another attention backend or GPU, weights altered in memory, other code that prepares frames.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.typing import NDArray
from torch import Tensor

from pipeline.base.arrays import array_of, code_size, widen
from pipeline.base.config import TuningParams, VLMParams
from pipeline.base.errors import CheckpointMismatch
from pipeline.base.packing import pack
from pipeline.base.printed_commands import command
from pipeline.base.projection import Basis
from pipeline.base.provenance import row_key
from pipeline.base.text import capped
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.vlm.live import LiveVLM, live_spec, refuse_other_features
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.slots import slot_deviations, slot_name, tolerance_of

_ROWS = 16
"""Frame sets in one pass of the model."""
_SHOWN = 6
"""Slots of a row that a message names."""


class LiveFeatures:
    """The frozen model of `vlm`, which computes a policy's features from live frames."""

    def __init__(
        self, vlm: VLMParams, trained: Mapping[str, Any], device: str, basis: Basis | None
    ) -> None:
        """Load the model; `trained` and `basis` are those of the policy's checkpoint.

        Raises `CheckpointMismatch`, before a weight is loaded, where the model gives other features
        than the policy was trained on, and `VLMError` as `LiveVLM.load` does.
        """
        self.spec = live_spec(vlm, trained["views"], basis)
        """The spec of the features that this model gives."""
        refuse_other_features(vlm, trained, self.spec)
        self._model = LiveVLM.load(vlm, self.spec, TuningParams(method="none"), device).eval()
        self._preparer = Preparer(vlm, self.spec)
        self._trained = trained

    def key(self, frames: Mapping[str, NDArray[np.uint8]], instruction: str) -> bytes:
        """The key (16 bytes) of these frames in the store that the policy was trained on."""
        prompt = self._preparer.render(instruction, list(frames))
        return row_key(self._trained["digest"], self._trained["views"], prompt, frames)

    @torch.inference_mode()
    def __call__(
        self, frames: Sequence[Mapping[str, "UInt8[ndarray, 'height width 3']"]], instruction: str
    ) -> tuple[Float[Tensor, "row slot dim"], Bool[Tensor, "row slot"]]:
        """Features in float32 of each set of RGB frames by view, and which slots are valid."""
        rows = [self._preparer.prepare(instruction, views) for views in frames]
        batches = [self._model(rows[at : at + _ROWS]) for at in range(0, len(rows), _ROWS)]
        features, valid = zip(*batches, strict=True)
        return torch.cat(features).cpu(), torch.cat(valid).cpu()


def prove(checkpoint: PolicyCheckpoint, features: LiveFeatures, say: Callable[[str], None]) -> None:
    """Compute the checkpoint's golden rows again, one row a pass as for a robot, and compare them.

    Raises `CheckpointMismatch` beyond the tolerance; it names slots and deviations. `say` gets the
    largest deviation of a number, relative to its size (`slot_deviations`), or a warning if the
    checkpoint has no golden rows.
    """
    if not checkpoint.golden:
        say(
            "WARNING: this checkpoint carries no golden rows, so that nothing proves that the live "
            "model gives the features it was trained on: only the feature specs were compared. "
            "Extract the store anew (stages.extract keeps golden rows) and train the head on it."
        )
        return
    spec = checkpoint.source["feature_spec"]
    slots, tolerance, largest = spec["slots"], tolerance_of(spec), (-1.0, 0)
    refused: list[str] = []
    for row in checkpoint.golden:
        live, valid = features([row.frames], row.instruction)
        held, today = (
            array_of(pack(numbers.float(), spec["storage_dtype"]))
            for numbers in (torch.from_numpy(row.features), live[0])
        )
        deviations = slot_deviations(widen(held), widen(today), code_size(held))
        worst_first = np.argsort(-deviations, kind="stable").tolist()
        largest = max(largest, (float(deviations.max()), worst_first[0]))
        other = np.flatnonzero(valid[0].numpy() != row.slot_valid).tolist()
        beyond = [slot for slot in worst_first if deviations[slot] > tolerance]
        if wrong := list(dict.fromkeys([*other, *beyond])):
            shown = [
                f"{slot_name(slots[slot])} "
                + ("is missing in one of both" if slot in other else f"{deviations[slot]:.1e}")
                for slot in wrong
            ]
            refused.append(f"  {row.instruction!r}: {', '.join(capped(shown, 'slots', _SHOWN))}")
    if refused:
        lines = [
            f"{len(refused)} of {len(checkpoint.golden)} golden rows are not the features that the "
            "policy was trained on: computed again by the live model, slots deviate by more than "
            f"{tolerance:.0e} of their size",
            *refused,
            "The feature specs agree: so the weights in memory, the code that prepares frames and "
            "prompts, the attention backend or a library is not what it was at extraction. Compare "
            f"with {command('verify', '--checkpoint')} on the machine that trained the head, or "
            "extract the store and train the head with the software of this one.",
        ]
        raise CheckpointMismatch("\n".join(lines))
    say(
        f"{len(checkpoint.golden)} golden rows computed again: the largest deviation is "
        f"{largest[0]:.1e} of its size ({slot_name(slots[largest[1]])}), "
        f"{tolerance:.0e} is tolerated"
    )
