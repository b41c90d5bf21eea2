"""How well features tell where the things of a scene lie, by how many scenes a regression saw.

A scene is the first frame of an episode that no demonstration and no rollout has. What its seed
drew, the place of the object, of the goal, or both, is regressed from all slots of a variant. The
arm is at rest there: features of a moving arm tell less.
"""

import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from experiments.metaworld.protocol import VARIANTS, Run, TrainedPolicy, prepare
from experiments.metaworld.recording import seeds_of
from experiments.sight import Frames, features_of, regressed
from pipeline.base.errors import ConfigError
from pipeline.base.text import Table
from pipeline.simulation.meta_world import MetaWorldEnvironment, instruction_of

FITTED: Final = (28, 100, 400)
"""Scenes that a regression sees; a policy of the protocol sees about 28."""
_HELD: Final = 200
_VARIES_MM: Final = 5.0
"""A coordinate that varies less is the same in all scenes."""


def write_sight(run: Run, fitted: Sequence[int] = FITTED, held: int = _HELD) -> Table:
    """Write `sight.json`, and return its table: the median error in mm in scenes not fitted.

    A row is a task and a variant; the first of a task sees nothing and says the mean place of the
    scenes that are fitted.

    Raises `ConfigError` for a variant whose model is not there, and a task whose places are fixed.
    """
    if any(VARIANTS[name].tuned for name in run.variants) and not (run.out / "tuned").exists():
        raise ConfigError(f"{run.out / 'tuned'}: no tuned model; run the variant tuned first")
    prepare(run)
    seeds = seeds_of("validation", 0)[: max(fitted) + held]
    rows: list[tuple[str | float, ...]] = []
    told = slice(max(fitted), None)
    with ProcessPoolExecutor(run.jobs, get_context("spawn")) as pool:
        for task in run.tasks:
            shown = pool.map(partial(_scene, task), seeds, chunksize=20)
            frames, drawn = zip(*tqdm(shown, task, len(seeds), disable=None), strict=True)
            places = np.stack(drawn)
            places = places[:, places.std(axis=0) > _VARIES_MM]
            if not places.size:
                raise ConfigError(f"{task}: its seeds draw nothing that varies by {_VARIES_MM} mm")
            blind = np.median(_distance(places[told] - places[: max(fitted)].mean(axis=0)))
            rows.append((task, "places' mean", *[round(float(blind), 1)] * len(fitted)))
            for name in run.variants:
                vlm = TrainedPolicy(run, name, task, 0).params().vlm
                features = features_of(vlm, frames, instruction_of(task))
                errors = [
                    regressed(features, places, slice(0, count), told) - places[told]
                    for count in fitted
                ]
                medians = [round(float(np.median(_distance(error))), 1) for error in errors]
                rows.append((task, name, *medians))
                print(*rows[-1], flush=True)
    content = {"fitted": list(fitted), "held": held, "median_error_mm": rows}
    (run.out / "sight.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    heads = ("task", "features", *(f"{count} scenes" for count in fitted))
    return Table(heads, rows, f"median error in mm in {held} other scenes")


_environment = cache(MetaWorldEnvironment)


def _scene(task: str, seed: int) -> tuple[Frames, NDArray[np.float64]]:
    environment = _environment(task)
    environment.reset(seed=seed)
    frames = {view: shot for view, (_, shot) in environment.frames().items()}
    return frames, environment.drawn_mm


def _distance(error: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(error, axis=1)
