"""How often the first look at a robot refuses what is right, and finds what is wrong.

    python -m experiments.first_look CHECKPOINT [--episodes N] [--moments]

Run where params.yaml is. What is right: the first frames and states of every recorded episode of
`data` and of simulated episodes at each level (with --moments: those of many moments of each
recording, and of no simulation), as they are and under other lamps. What is wrong: the same with
views exchanged in every way, red and blue exchanged in all views or in one, states in radians or
metres, and in other orders.

The last line is JSON: of each reading how many were refused, and how many there were.
"""

import json
import math
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.config import Level, load_params
from pipeline.base.errors import ObservationError
from pipeline.data import open_recordings
from pipeline.policy.checkpoint import PolicyCheckpoint, find_policy, load_policy
from pipeline.robot.first_look import FirstLook
from pipeline.simulation.environment import InsertionEnvironment

FIRST_SEED = 2_000_000
MOMENTS = 40
"""Of a recording that are looked at, evenly spread."""
LAMPS = {
    "half as bright": (0.5, 0.5, 0.5),
    "a third brighter": (1.33, 1.33, 1.33),
    "warmer lamp": (1.2, 1.0, 0.8),
    "colder lamp": (0.8, 1.0, 1.2),
}
"""Gains of red, green and blue under which what is right stays right."""

Frames = dict[str, NDArray[np.uint8]]
State = NDArray[np.floating[Any]] | None
Seen = tuple[str, Frames, State]


def main() -> None:
    """Look, count, print."""
    parser = ArgumentParser("experiments.first_look", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--episodes", type=int, default=200, help="simulated, of each level")
    parser.add_argument("--moments", action="store_true", help="many of each recording")
    wanted = parser.parse_args()
    checkpoint = load_policy(find_policy(wanted.checkpoint))
    look, counts, refused = FirstLook(checkpoint), Counter[str](), Counter[str]()
    seen = [*_recorded(wanted.moments), *(() if wanted.moments else _simulated(wanted.episodes))]
    for where, frames, state in tqdm(seen, "looking", disable=None):
        for reading, shown, read in _readings(checkpoint, where, frames, state):
            counts[reading] += 1
            try:
                look.check(shown, read)
            except ObservationError as error:
                refused[reading] += 1
                if reading.startswith("right"):
                    print(f"FALSE ALARM, {where}: {error}")
    table = {reading: [refused[reading], count] for reading, count in counts.items()}
    for reading, (hits, count) in table.items():
        print(f"{reading:<40} {hits:>6} of {count}")
    print(json.dumps({"experiment": "first_look", "checkpoint_step": checkpoint.step, **table}))


def _recorded(moments: bool) -> Iterator[Seen]:
    """What the recordings of `data` show first, or at many moments."""
    params = load_params(Path("params.yaml"), [])
    opened = open_recordings(params.data.sources, params.data.root, params.data.views)
    for recording in opened.recordings:
        cameras, state = recording.cameras(), recording.state()
        for at in np.linspace(0, 1, MOMENTS) if moments else [0.0]:
            frames = {
                view: next(iter(camera.read([int(at * (len(camera.time) - 1))])))
                for view, camera in cameras.items()
            }
            row = None if state is None else state.values[[int(at * (len(state.time) - 1))]]
            yield f"recorded, {recording.source}", frames, row


def _simulated(episodes: int) -> Iterator[Seen]:
    for level in get_args(Level):
        for seed in range(FIRST_SEED, FIRST_SEED + episodes):
            robot = InsertionEnvironment(level)
            robot.reset(seed=seed)
            frames = {view: frame for view, (_, frame) in robot.frames().items()}
            yield f"simulated, {level}", frames, robot.readings()["state"]


def _readings(
    checkpoint: PolicyCheckpoint, where: str, frames: Frames, state: State
) -> Iterator[Seen]:
    """The right reading, then every wrong one."""
    yield f"right ({where})", frames, state
    for lamp, gain in LAMPS.items():
        lit = {v: (frame * np.array(gain)).clip(0, 255).astype("u1") for v, frame in frames.items()}
        yield f"right, {lamp}", lit, state
    views = sorted(frames)
    for order in permutations(views):
        if moved := [v for v, shown in zip(views, order, strict=True) if v != shown]:
            exchanged = {v: frames[shown] for v, shown in zip(views, order, strict=True)}
            yield f"views exchanged: {', '.join(moved)}", exchanged, state
    reversed_ = {view: frame[..., ::-1] for view, frame in frames.items()}
    yield "red and blue exchanged: all views", reversed_, state
    for view in views:
        yield f"red and blue exchanged: {view}", frames | {view: reversed_[view]}, state
    if state is not None and checkpoint.normalization.state is not None:
        units = np.array(checkpoint.source["streams"]["state"]["units"])
        for unit, name, factor in (
            ("deg", "radians", math.pi / 180),
            ("rad", "degrees", 180 / math.pi),
            ("mm", "metres", 1e-3),
        ):
            if (units == unit).any():
                yield f"state in {name}", frames, np.where(units == unit, state * factor, state)
        half = len(units) // 2
        yield "state: halves exchanged", frames, np.roll(state, half, axis=1)
        yield "state: reversed", frames, state[:, ::-1]
        exchanged_two = [1, 0, *range(2, len(units))]
        yield "state: the first two channels exchanged", frames, state[:, exchanged_two]


if __name__ == "__main__":
    main()
