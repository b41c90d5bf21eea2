"""The live model gives the features that the policy was trained on: proved on the golden rows.

It sees what no feature spec tells: another attention backend or GPU, weights altered in memory, a
preparation of frames that is not that of extraction.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.base.errors import CheckpointMismatch
from pipeline.base.golden import GoldenRow
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.robot.features import LiveFeatures
from pipeline.vlm.deviation import SlotDeviations, slot_deviations, tolerance_of
from pipeline.vlm.feature_spec import live_differences
from pipeline.vlm.slots import slot_name

_SHOWN = 6
"""Slots of a row that a message names."""


@dataclass(frozen=True)
class Proof:
    """What came of computing the golden rows again: none was refused."""

    rows: int
    """0 where the checkpoint has none, and its feature spec alone was compared."""
    largest: float
    """The largest deviation of a number, relative to the root mean square of its slot."""
    slot: str
    """In which slot that was, in words."""
    tolerance: float
    """That follows from the dtypes in which the features were computed and stored."""

    def __str__(self) -> str:
        return (
            f"{self.rows} golden rows computed again: the largest deviation is {self.largest:.1e} "
            f"of a slot's root mean square ({self.slot}), {self.tolerance:.0e} is tolerated"
        )


@dataclass(frozen=True)
class _Recomputed:
    """A golden row, what it is today and how far its slots are apart."""

    row: GoldenRow
    prompt: str
    apart: SlotDeviations
    other_valid: list[int]
    """Slots that are valid in one of both only."""

    def refused(self, tolerance: float) -> list[int]:
        """The slots that are not those of the policy's store, the worst first."""
        return list(dict.fromkeys([*self.other_valid, *self.apart.beyond(tolerance)]))


def prove(
    checkpoint: PolicyCheckpoint, features: LiveFeatures, say: Callable[[str], None]
) -> Proof:
    """Compute the checkpoint's golden rows as frames of a robot are, and compare.

    Raises `CheckpointMismatch` beyond the tolerance, which names slots, deviations, the entries of
    the feature spec that differ, and both prompts where they do. `say` is told what came of it, and
    warned where a checkpoint carries no golden rows.
    """
    spec = checkpoint.source["feature_spec"]
    tolerance = tolerance_of(spec) if checkpoint.golden else 0.0
    if not checkpoint.golden:
        say(
            "WARNING: this checkpoint carries no golden rows, so that nothing proves that the live "
            "model gives the features it was trained on: only the feature specs were compared. "
            "Extract the store anew (stages.extract keeps golden rows) and train the head on it."
        )
        return Proof(0, 0.0, "", tolerance)
    rows = [_recomputed(row, features) for row in checkpoint.golden]
    if any(row.refused(tolerance) for row in rows):
        raise CheckpointMismatch("\n".join(_refusal(spec, features, rows, tolerance)))
    worst = max(rows, key=lambda row: row.apart.relative.max())
    slot = slot_name(spec["slots"][worst.apart.worst])
    proof = Proof(len(rows), float(worst.apart.relative.max()), slot, tolerance)
    say(str(proof))
    return proof


def _recomputed(row: GoldenRow, features: LiveFeatures) -> _Recomputed:
    """One row a pass, as a robot asks for it."""
    live, valid = features([row.frames], row.instruction)
    apart = slot_deviations(row.features, live[0].numpy())
    other = [slot for slot, same in enumerate(valid[0].numpy() == row.slot_valid) if not same]
    return _Recomputed(row, features.prompt(row.instruction, list(row.frames)), apart, other)


def _refusal(
    spec: Mapping[str, Any], features: LiveFeatures, rows: list[_Recomputed], tolerance: float
) -> list[str]:
    """For people: what deviates, by how much, and what is known of the reason."""
    beyond = [(row, slots) for row in rows if (slots := row.refused(tolerance))]
    lines = [
        f"{len(beyond)} of {len(rows)} golden rows are not the features that the policy was "
        f"trained on. Computed again by the live model, slots deviate by more than {tolerance:.0e} "
        "of their root mean square:"
    ]
    for row, slots in beyond:
        shown = (_said(spec, row, slot) for slot in slots[:_SHOWN])
        more = f" and {len(slots) - _SHOWN} more" if len(slots) > _SHOWN else ""
        lines.append(f"  {row.row.instruction!r}: {', '.join(shown)}{more}")
    for row, _ in beyond:
        if row.prompt != row.row.prompt:
            lines += [f"prompt, trained: {row.row.prompt!r}", f"prompt, live:    {row.prompt!r}"]
            break
    differing = live_differences(spec, features.spec.document)
    lines += [f"feature spec, {line} (trained -> live)" for line in differing] or [
        "The feature specs agree in every entry: so the weights in memory, the code that prepares "
        "frames, the attention backend or a library is not what it was at extraction."
    ]
    lines.append(
        "Compare with python -m stages.verify --checkpoint on the machine that trained the head, "
        "or extract the store and train the head with the software of this one."
    )
    return lines


def _said(spec: Mapping[str, Any], row: _Recomputed, slot: int) -> str:
    what = "is missing in one of both" if slot in row.other_valid else ""
    return f"{slot_name(spec['slots'][slot])} {what or f'{row.apart.relative[slot]:.1e}'}"
