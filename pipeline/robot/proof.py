"""The live model gives the features that the policy was trained on: proved on the golden rows.

It sees what no feature spec tells: another attention backend or GPU, weights altered in memory, a
preparation of frames that is not that of extraction.
"""

from collections.abc import Callable

import numpy as np

from pipeline.base.commands import command
from pipeline.base.errors import CheckpointMismatch
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.robot.features import LiveFeatures
from pipeline.vlm.deviation import slot_deviations, tolerance_of
from pipeline.vlm.feature_spec import live_differences
from pipeline.vlm.slots import slot_name

_SHOWN = 6
"""Slots of a row that a message names."""


def prove(checkpoint: PolicyCheckpoint, features: LiveFeatures, say: Callable[[str], None]) -> None:
    """Compute the checkpoint's golden rows as frames of a robot are, and compare.

    Raises `CheckpointMismatch` beyond the tolerance, which names slots, deviations, the entries of
    the feature spec that differ, and both prompts where they do. `say` is told the largest
    deviation of a number, relative to the root mean square of its slot, and warned where a
    checkpoint carries no golden rows.
    """
    if not checkpoint.golden:
        say(
            "WARNING: this checkpoint carries no golden rows, so that nothing proves that the live "
            "model gives the features it was trained on: only the feature specs were compared. "
            "Extract the store anew (stages.extract keeps golden rows) and train the head on it."
        )
        return
    spec = checkpoint.source["feature_spec"]
    tolerance, largest = tolerance_of(spec), (-1.0, 0)
    refused: list[str] = []
    prompts: list[str] = []
    for row in checkpoint.golden:  # a pass for each, as a robot asks for it
        live, valid = features([row.frames], row.instruction)
        apart = slot_deviations(row.features, live[0].numpy())
        largest = max(largest, (float(apart.relative.max()), apart.worst))
        other = np.flatnonzero(valid[0].numpy() != row.slot_valid).tolist()
        slots = list(dict.fromkeys([*other, *apart.beyond(tolerance)]))
        if slots:
            shown = ", ".join(
                f"{slot_name(spec['slots'][slot])} "
                + ("is missing in one of both" if slot in other else f"{apart.relative[slot]:.1e}")
                for slot in slots[:_SHOWN]
            )
            more = f" and {len(slots) - _SHOWN} more" if len(slots) > _SHOWN else ""
            refused.append(f"  {row.instruction!r}: {shown}{more}")
        prompt = features.prompt(row.instruction, list(row.frames))
        if prompt != row.prompt:
            prompts = [f"prompt, trained: {row.prompt!r}", f"prompt, live:    {prompt!r}"]
    if refused or prompts:
        differing = live_differences(spec, features.spec.document)
        lines = [
            f"{len(refused)} of {len(checkpoint.golden)} golden rows are not the features that the "
            "policy was trained on: computed again by the live model, slots deviate by more than "
            f"{tolerance:.0e} of their root mean square",
            *refused,
            *prompts,
            *(f"feature spec, {line} (trained -> live)" for line in differing),
        ]
        if not differing:
            lines.append(
                "The feature specs agree in every entry: so the weights in memory, the code that "
                "prepares frames, the attention backend or a library is not what it was at "
                "extraction."
            )
        lines.append(
            f"Compare with {command('verify', '--checkpoint')} on the machine that trained the "
            "head, or extract the store and train the head with the software of this one."
        )
        raise CheckpointMismatch("\n".join(lines))
    say(
        f"{len(checkpoint.golden)} golden rows computed again: the largest deviation is "
        f"{largest[0]:.1e} of a slot's root mean square ({slot_name(spec['slots'][largest[1]])}), "
        f"{tolerance:.0e} is tolerated"
    )
