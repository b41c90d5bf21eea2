"""The hidden parameters of an episode, and how they are drawn.

Each group draws from its own generator, so a change of one group does not change the others.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Level
from pipeline.data.timeline import wrapped_deg
from pipeline.simulation.arm import NOMINAL_POSE, angles_deg, orientation

WORKSPACE_MM: Final = np.array([6.5, 4.0])
"""Needle and target begin at most this far from the bench's middle, in x and y."""

_ABOVE_MM = 0.3
_PUSHES = 3
_PUSH_MM: Final = (3.0, 8.0)
_PUSH_EVERY_S: Final = (0.7, 1.4)
_TISSUE: Final = ((0.9, 1.3), (0.5, 0.9), (0.9, 1.3), (0.2, 0.3), (0.1, 0.18), (2.0, 3.2))
"""Bounds between which each field of `Tissue` is drawn, in the order of the fields."""


@dataclass(frozen=True)
class Tissue:
    """Soft tissue: a stiffening spring, then a needle that cuts and rubs."""

    stiffness_n_mm: float
    stiffening_n_mm2: float
    puncture_n: float
    cutting_n: float
    friction_n_mm: float
    layer_depth_mm: float

    def spring_n(self, indentation_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Force of the unbroken surface for an indentation of 0 or more."""
        return self.stiffness_n_mm * indentation_mm + self.stiffening_n_mm2 * indentation_mm**2

    def drag_n(self, depth_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Force on a needle whose tip is this deep under a punctured surface."""
        return self.cutting_n + self.friction_n_mm * np.maximum(depth_mm, 0)


@dataclass(frozen=True)
class InsertionLayout:
    """The hidden parameters of an episode.

    `bench_mm` (2,), `start_pose` (6,) and `surfaces_mm` (place,) are in the base frame,
    `targets_mm` (place, 2) in the bench frame. The phantom begins at place 0 and moves to the next
    place at each push that happens. `upright_deg` (3,) are a b r of a needle that points straight
    down.
    """

    seed: int
    bench_mm: NDArray[np.float64]
    start_pose: NDArray[np.float64]
    upright_deg: NDArray[np.float64]
    targets_mm: NDArray[np.float64]
    surfaces_mm: NDArray[np.float64]
    push_times_s: NDArray[np.float64]
    breath: tuple[float, float, float]
    """Height in mm, rate in Hz and phase of the surface's breathing."""
    tissue: Tissue
    speed_mm_s: float
    brightness: float
    oct_gain: float

    def breath_mm(self, time_s: float) -> float:
        """How far breathing lifts the surface at a time of the episode."""
        height, rate_hz, phase = self.breath
        return height * math.sin(2 * math.pi * rate_hz * time_s + phase)


def draw_layout(seed: int, level: Level = "full", crosses_180: bool = False) -> InsertionLayout:
    """The episode of a seed; with `crosses_180` its angle r passes ±180° on the way upright."""
    bench, lateral, depth, hand, look, breath = (np.random.default_rng([seed, i]) for i in range(6))
    bench_mm = NOMINAL_POSE[:2] + bench.uniform(-15, 15, 2)
    surface = NOMINAL_POSE[2] + bench.uniform(-10, 10)
    rises = depth.uniform(0.5, 1.2, _PUSHES) * depth.choice([-1, 1], _PUSHES)
    start_xy = bench_mm + hand.uniform(-WORKSPACE_MM, WORKSPACE_MM)
    start_z = surface + depth.uniform(3.8, 5.0)
    targets = _targets(lateral)
    if level == "depth":
        start_xy = bench_mm + targets[0] + hand.uniform(-_ABOVE_MM, _ABOVE_MM, 2)
    pushes = _PUSHES if level == "moved" else 0
    upright, leaning = _orientations(hand.uniform(-8, 8, 2), crosses_180)
    return InsertionLayout(
        seed=seed,
        bench_mm=bench_mm,
        start_pose=np.concatenate([start_xy, [start_z], leaning]),
        upright_deg=upright,
        targets_mm=targets,
        surfaces_mm=surface + np.concatenate([[0.0], _bounded_walk(rises)]),
        push_times_s=np.cumsum(lateral.uniform(*_PUSH_EVERY_S, pushes)),
        breath=(breath.uniform(0.03, 0.1), breath.uniform(0.2, 0.35), breath.uniform(0, 2 * np.pi)),
        tissue=Tissue(*(float(depth.uniform(*within)) for within in _TISSUE)),
        speed_mm_s=float(hand.uniform(6, 9)),
        brightness=float(look.uniform(0.94, 1.06)),
        oct_gain=float(look.uniform(0.92, 1.08)),
    )


def _targets(rng: np.random.Generator) -> NDArray[np.float64]:
    targets = [rng.uniform(-WORKSPACE_MM, WORKSPACE_MM)]
    while len(targets) <= _PUSHES:
        target = rng.uniform(-WORKSPACE_MM, WORKSPACE_MM)
        if _PUSH_MM[0] <= np.hypot(*(target - targets[-1])) <= _PUSH_MM[1]:
            targets.append(target)
    return np.stack(targets)


def _bounded_walk(rises: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights after each rise; a rise that would lead farther than 1.5 mm is reversed."""
    heights: list[float] = []
    height = 0.0
    for rise in rises:
        height = height + rise if abs(height + rise) <= 1.5 else height - rise
        heights.append(float(height))
    return np.array(heights)


def _orientations(
    lean_deg: NDArray[np.float64], crosses_180: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The upright and the starting a b r; angles of both are continuous, not wrapped."""
    upright = NOMINAL_POSE[3:].copy()
    lean = orientation(np.zeros(3)).from_rotvec([*lean_deg, 0.0], degrees=True)
    turn = wrapped_deg(angles_deg(lean * orientation(upright)) - upright)
    if crosses_180:
        # Spin about the needle changes only r: start half the turn before 180°, end half after.
        upright[2] = 180.0 - turn[2] / 2
    return upright, upright + turn
