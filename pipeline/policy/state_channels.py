"""Robot states as networks take them: angles and rotations without a jump at a full turn."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.policy.shape import Kind


def expand(
    values: Float[Tensor, "batch reading channel"], kinds: Sequence[Kind]
) -> Float[Tensor, "batch reading expanded"]:
    """Windows of states (float32) with angles as sines and cosines, and rotations in six numbers.

    A pose's rotation R = Rx(a)·Ry(b)·Rz(r) is taken relative to that of the window's last reading,
    and written as the first two columns of the matrix (Zhou et al. 2019, "On the Continuity of
    Rotation Representations", section 4.2). So a full turn more changes nothing.
    """
    if not {*kinds} - {"plain"}:
        return values
    values = values.float()
    parts = [_of_kind(values, kinds, "plain")]
    degrees = [math.pi / 180 if kind == "deg" else 1.0 for kind in kinds if kind in ("deg", "rad")]
    angles = _of_kind(values, kinds, "deg", "rad") * values.new_tensor(degrees)
    parts += [angles.sin(), angles.cos()]
    if "rotation" in kinds:
        matrices = rotation_matrix(_of_kind(values, kinds, "rotation").deg2rad())
        relative = matrices[:, -1:].mT @ matrices
        parts.append(relative[..., :2].mT.flatten(2))
    return torch.cat(parts, dim=-1)


def typical_state(mean: Sequence[float], kinds: Sequence[Kind]) -> list[float]:
    """A state (channel,) whose `expand` is nearest to the mean (expanded,).

    Rotations are 0: relative to itself a reading has none.
    """
    if not {*kinds} - {"plain"}:
        return list(mean)
    plain, angles = kinds.count("plain"), kinds.count("deg") + kinds.count("rad")
    waves = mean[plain : plain + 2 * angles]
    known = iter(mean[:plain])
    turned = iter(zip(waves[:angles], waves[angles:], strict=True))
    state: list[float] = []
    for kind in kinds:
        angle = math.atan2(*next(turned)) if kind in ("deg", "rad") else 0.0
        written = math.degrees(angle) if kind == "deg" else angle
        state.append(next(known) if kind == "plain" else written)
    return state


def _of_kind(values: Tensor, kinds: Sequence[Kind], *wanted: Kind) -> Tensor:
    return values[..., [place for place, kind in enumerate(kinds) if kind in wanted]]


def rotation_matrix(angles: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rx(a)·Ry(b)·Rz(r) of (a, b, r) in radians."""
    (sa, sb, sr), (ca, cb, cr) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    rows = [
        [cb * cr, -cb * sr, sb],
        [ca * sr + sa * sb * cr, ca * cr - sa * sb * sr, -sa * cb],
        [sa * sr - ca * sb * cr, sa * cr + ca * sb * sr, ca * cb],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
