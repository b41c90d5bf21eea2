"""The demonstrator: a hand that sees the target and the A-scan.

It aligns over the target at limited speed while it descends to a standoff. Then it descends
further, more slowly the worse it is aligned, punctures, and stops at the target layer. It waits by
standing still, never by rising: if it rose in one place and sank in another, a policy that imitates
it and cannot tell the two places apart would hover. It acts on the target's place `REACTION_TICKS`
ago, which the newest frames show.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

REACTION_TICKS: Final = 1
ALIGNED_MM: Final = 0.3
"""Up to this distance the needle descends at full speed; from `NOT_ALIGNED_MM` on it stops."""
NOT_ALIGNED_MM: Final = 0.8
STANDOFF_MM: Final = 1.4

_LATERAL_GAIN_HZ, _APPROACH_GAIN_HZ, _LAYER_GAIN_HZ, _TURN_GAIN_HZ = 4.0, 3.0, 4.0, 2.0
_DESCENT_MM_S, _INSERTION_MM_S, _TURN_DEG_S = 3.5, 1.5, 9.0
_TREMOR_MM, _TREMOR_DEG = 0.012, 0.012
_SMOOTHING = 0.5
"""Share of the velocity that carries over from the last tick."""


def expert_motion(
    offset_mm: NDArray[np.float64],
    distance_mm: float,
    layer_mm: float,
    inside: bool,
    turn_deg: NDArray[np.float64],
    velocity: NDArray[np.float64],
    speed_mm_s: float,
    tick_s: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """The motion (6,) of one tick: translation in mm, rotation vector in degrees, base frame.

    `offset_mm` (2,) is from needle to target, `distance_mm` from tip to surface and `layer_mm` from
    tip to target layer; `inside` is whether the tip is in the tissue, `turn_deg` (3,) the rotation
    vector to the upright, and `velocity` (6,) the arm's motion in the last tick.
    """
    lateral = np.zeros(2) if inside else _limited(_LATERAL_GAIN_HZ * offset_mm, speed_mm_s)
    if inside:
        downward = np.clip(_LAYER_GAIN_HZ * layer_mm, -_INSERTION_MM_S, _INSERTION_MM_S)
    else:
        approach = np.clip(_APPROACH_GAIN_HZ * (distance_mm - STANDOFF_MM), 0, _DESCENT_MM_S)
        miss = float(np.hypot(*offset_mm))
        aligned = np.clip((NOT_ALIGNED_MM - miss) / (NOT_ALIGNED_MM - ALIGNED_MM), 0, 1)
        downward = max(approach, aligned * _INSERTION_MM_S)
    turn = _limited(_TURN_GAIN_HZ * turn_deg, _TURN_DEG_S)
    wanted = np.concatenate([lateral, [-float(downward)], turn]) * tick_s
    motion = _SMOOTHING * velocity + (1 - _SMOOTHING) * wanted
    tremor = rng.standard_normal(6) * np.repeat([_TREMOR_MM, _TREMOR_DEG], 3)
    # Tissue holds a needle that is inside it.
    tremor[:2] *= not inside
    return motion + tremor


def _limited(velocity: NDArray[np.float64], limit: float) -> NDArray[np.float64]:
    length = float(np.linalg.norm(velocity))
    return velocity if length <= limit else velocity * (limit / length)
