"""Rollouts that need no policy and no simulation."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pipeline.evaluate.rollouts import InsertionTrace, RolloutEpisode, Rollouts

VIEWS = ("View1", "View2")
ENDINGS = ("time is up", "punctured beside the target", "safe stop: the sensor stalled")


def frames(time_s: float) -> dict[str, np.ndarray]:
    shade = np.uint8(min(255, 20 * time_s))
    return {view: np.full((126, 224, 3), shade, np.uint8) for view in VIEWS}


def rollout_episode(seed: int = 0, ticks: int = 60, **changed: Any) -> RolloutEpisode:
    """The needle comes down on a straight line, from another side with every seed."""
    part = np.linspace(0, 1, ticks)
    miss = 0.2 + 0.1 * (seed % 5)
    way = (6 * (1 - part) + miss)[:, None] * [np.cos(seed), np.sin(seed)]
    height = 4 - 6.5 * part
    trace = InsertionTrace(
        time_s=0.1 * np.arange(1, ticks + 1),
        offset_mm=way,
        lateral_mm=way[-1],
        height_mm=height,
        layer_mm=height + 2.5,
        force_n=np.where(height < 0, 0.6, 0.0),
    )
    given = {
        "controller": "policy", "seed": seed, "level": "full", "success": True,
        "reason": "inserted", "lateral_mm": miss, "depth_mm": 0.05, "overshoot_mm": 0.1,
        "max_force_n": 0.6, "time_s": 0.1 * ticks, "ticks": ticks, "trace": trace,
        "frames": frames,
    }  # fmt: skip
    return RolloutEpisode(**given | changed)


def failed(seed: int = 0, **changed: Any) -> RolloutEpisode:
    """An episode that ends short of the layer."""
    reason = ENDINGS[seed % len(ENDINGS)]
    return rollout_episode(seed, **{"success": False, "reason": reason, "depth_mm": 1.5} | changed)


def rollouts_of(*episodes: RolloutEpisode) -> Rollouts:
    settings = {"execute": 1, "chunking": "none", "latency_ms": 0, "seed": 1000000}
    return Rollouts("models/head", settings, episodes)


@pytest.fixture(scope="session")
def rollouts() -> Rollouts:
    """Five episodes of every controller: the demonstrator always succeeds."""
    return rollouts_of(
        *(rollout_episode(seed) if seed < 3 else failed(seed) for seed in range(5)),
        *(rollout_episode(seed, controller="expert") for seed in range(5)),
        *(failed(seed, controller="features off", lateral_mm=40.0) for seed in range(5)),
    )


@pytest.fixture(scope="session")
def make_episode() -> Callable[..., RolloutEpisode]:
    """`make_episode(seed, **fields)`: inserted, unless its fields tell otherwise."""
    return rollout_episode


@pytest.fixture(scope="session")
def make_rollouts() -> Callable[..., Rollouts]:
    """`make_rollouts(*episodes)`."""
    return rollouts_of
