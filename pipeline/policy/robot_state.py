"""Robot states: their channels as networks take them, and chunks that count from a past state.

What vision tells, such as the way to a target, is true at the time of the frame. So anchored
channels of a chunk count from the state at that time: in training the first step has the motion
since then added, and the policy's answer has the measured motion subtracted. So the target stays in
place while the model is late. Every later step counts from the step before it.

The state is interpolated on its own clock, between the readings of its window; before the first
reading the arm is assumed to stand still.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.base.observation import Observation
from pipeline.policy.shape import Anchor, Kind

Chunks = Float[Tensor, "*sample batch horizon action"]
_FULL_TURN: dict[Kind, float] = {"deg": 360.0, "rad": 2 * torch.pi, "rotation": 360.0}
_LEAST = 1e-12


def expand(
    values: Float[Tensor, "batch reading channel"], kinds: Sequence[Kind]
) -> Float[Tensor, "batch reading expanded"]:
    """Windows of states (float32) with angles as sines and cosines, and rotations in six numbers.

    A pose's rotation R = Rx(a)·Ry(b)·Rz(r) is taken relative to that of the window's last reading,
    and written as the first two columns of the matrix (Zhou et al. 2019, "On the Continuity of
    Rotation Representations", section 4.2). So another full turn changes nothing.
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


@dataclass(frozen=True)
class Anchoring:
    """Moves the origin of chunks in physical units; `kinds` are those of the state's channels.

    Rotation vectors are composed, R(step)·R(tick)·R(frame)ᵀ. A sample without features or states
    counts from its tick.
    """

    anchors: Sequence[Anchor]
    kinds: Sequence[Kind]

    def from_frame(self, chunks: Chunks, seen: Observation) -> Chunks:
        """The chunks counted from the newest frame; `chunks` count from the tick."""
        return self._moved(chunks, seen, 1.0)

    def from_tick(self, chunks: Chunks, seen: Observation) -> Chunks:
        """The inverse of `from_frame`: the chunks that the robot executes."""
        return self._moved(chunks, seen, -1.0)

    def _moved(self, chunks: Chunks, seen: Observation, sign: float) -> Chunks:
        if not self.anchors:
            return chunks
        known = seen.slot_valid.any(dim=1) & (seen.state_valid > 0)
        now = seen.state[:, -1].float()
        then = torch.where(known.unsqueeze(1), state_at_frame(seen, self.kinds), now)
        first = list(chunks[..., 0, :].unbind(-1))
        for anchor in self.anchors:
            channels = list(anchor.state)
            step = torch.stack([first[channel] for channel in anchor.action], dim=-1)
            if anchor.composed:
                turn = _turn(now[:, channels], then[:, channels])
                turn = turn if sign > 0 else turn.transpose(-1, -2)
                step = _vector(_matrix(step.deg2rad()) @ turn).rad2deg()
            else:
                kinds: list[Kind] = [self.kinds[channel] for channel in channels]
                step = step + sign * _difference(now[:, channels], then[:, channels], kinds)
            for channel, moved in zip(anchor.action, step.unbind(-1), strict=True):
                first[channel] = moved
        return torch.cat([torch.stack(first, dim=-1).unsqueeze(-2), chunks[..., 1:, :]], dim=-2)


@dataclass(frozen=True)
class RelativeActions:
    """Absolute chunks as differences from the state at the tick, and back, in physical units.

    Every step counts from the same state; angles go the short way round. A sample without a state
    gives NaN, which stops a robot.
    """

    channels: Sequence[Anchor]
    kinds: Sequence[Kind]

    def from_absolute(self, chunks: Chunks, seen: Observation) -> Chunks:
        """What the policy learns."""
        return self._moved(chunks, seen, back=False)

    def to_absolute(self, chunks: Chunks, seen: Observation) -> Chunks:
        """The inverse of `from_absolute`: what the robot executes."""
        return self._moved(chunks, seen, back=True)

    def _moved(self, chunks: Chunks, seen: Observation, back: bool) -> Chunks:
        if not self.channels:
            return chunks
        known = (seen.state_valid > 0).unsqueeze(1)
        now = torch.where(known, seen.state[:, -1].float(), torch.nan).unsqueeze(1)
        columns = list(chunks.float().unbind(-1))
        for channel in self.channels:
            (action,), (place,) = channel.action, channel.state
            own, here = columns[action].unsqueeze(-1), now[..., place : place + 1]
            moved = own + here if back else _difference(own, here, [self.kinds[place]])
            columns[action] = moved.squeeze(-1)
        return torch.stack(columns, dim=-1)


def state_at_frame(seen: Observation, kinds: Sequence[Kind]) -> Float[Tensor, "batch channel"]:
    """The state at the newest frame, linear between readings; angles go the short way round."""
    state, readings = seen.state.float(), seen.state.shape[1]
    age_s, oldest = seen.feature_age.float().unsqueeze(1), readings - seen.state_valid.unsqueeze(1)
    # Readings that are not real have age 0.
    older = (seen.state_age > age_s).sum(dim=1, keepdim=True)
    later = (oldest + older).clamp(max=readings - 1)
    earlier = torch.minimum((later - 1).clamp(min=0).maximum(oldest), later)
    age_before, age_after = (seen.state_age.gather(1, place) for place in (earlier, later))
    share = ((age_before - age_s) / (age_before - age_after).clamp(min=_LEAST)).clamp(0.0, 1.0)
    width = state.shape[-1]
    before, after = (
        state.gather(1, place.unsqueeze(-1).expand(-1, -1, width)).squeeze(1)
        for place in (earlier, later)
    )
    return before + share * _difference(after, before, kinds)


def _turn(
    now: Float[Tensor, "batch 3"], then: Float[Tensor, "batch 3"]
) -> Float[Tensor, "batch 3 3"]:
    """The rotation from one pose's angles in degrees to another's, in the base frame."""
    here, there = (rotation_matrix(angles.deg2rad()) for angles in (now, then))
    return here @ there.transpose(-1, -2)


def _difference(later: Tensor, earlier: Tensor, kinds: Sequence[Kind]) -> Tensor:
    """`later` less `earlier`, (…, channel); angles the short way round."""
    turn = later.new_tensor([_FULL_TURN.get(kind, torch.inf) for kind in kinds])
    change = later - earlier
    return torch.where(turn.isinf(), change, change - turn * (change / turn).round())


def _matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation matrix of a rotation vector in rad (Rodrigues)."""
    angle = vector.square().sum(-1, keepdim=True).clamp(min=_LEAST).sqrt().unsqueeze(-1)
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    cross = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    identity = torch.eye(3, device=vector.device, dtype=vector.dtype)
    straight, curved = angle.sin() / angle, (1 - angle.cos()) / angle.square()
    return identity + straight * cross + curved * (cross @ cross)


def _vector(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The rotation vector in rad of a rotation matrix by less than half a turn."""
    skew = matrix - matrix.transpose(-1, -2)
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1) / 2
    sine = axis.square().sum(-1, keepdim=True).clamp(min=_LEAST).sqrt()
    cosine = (matrix.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    return axis * (torch.atan2(sine, cosine) / sine)


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
