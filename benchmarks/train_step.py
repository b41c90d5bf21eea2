"""What a training step waits for its data, and how near it comes to data that is there already.

The default head of `params.yaml` is trained on a synthetic store (1,026 sensor channels, windows of
65, 2,048 features) with batches of the feed, and with batches that were gathered beforehand: into
RAM, from where a step has to take them to its device. Each round trains a few steps of each in
turn; all share one model, whose step costs the same whatever it has learnt.
"""

import itertools
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.stores import write_store
from benchmarks.timing import Work, arguments, at_least, at_most, race, report
from pipeline.base.config import TrainHeadParams, load_params
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices, Prefetch, Windows
from pipeline.train.loop import Trainer
from pipeline.train.run import TrainingRun
from pipeline.train.split import split_by_episode

FEED, RAM = "mapped", "batches in RAM"
FULL = {"episodes": 20, "ticks": 600, "readings": 4_800, "states": 1_200, "steps": 10}
QUICK = {"episodes": 3, "ticks": 40, "readings": 320, "states": 80, "steps": 1}
SMALL = {
    "batch_size": 4,
    "sensor_encoder": {"kind": "joint", "channels": [8], "layers": 1, "heads": 2, "output_dim": 8},
}
_ENDLESS = range(10**9)


class Contender:
    """Steps of one trainer with the batches of one feed, and how long they were waited for."""

    def __init__(self, trainer: Trainer, feed: Prefetch | None, steps: int) -> None:
        self._trainer, self._feed, self._steps = trainer, feed, steps
        self._batches = iter(_kept(trainer, steps) if feed is None else feed)
        self.wait_shares: list[float] = []

    def run(self) -> None:
        """A few steps, waited for to the end."""
        begun, waited = time.perf_counter(), self._waited
        for _ in range(self._steps):
            parts = itertools.islice(self._batches, self._trainer.params.grad_accumulation)
            self._trainer.learn(parts)
        if self._trainer.device.type == "cuda":
            torch.cuda.synchronize(self._trainer.device)
        taken = time.perf_counter() - begun
        self.wait_shares.append((self._waited - waited) / taken)

    @property
    def _waited(self) -> float:
        return 0.0 if self._feed is None else self._feed.waited_s


def main() -> None:
    """Build, train, print, clean up."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N")
    parser.add_argument("--folder", type=Path, default=None, help="scratch; a temporary one")
    options = parser.parse_args()
    sizes = QUICK if options.quick else FULL
    folder = Path(tempfile.mkdtemp(prefix="train-step-", dir=options.folder))
    try:
        trainer = make_trainer(folder, sizes, options.device, options.quick)
        rounds = options.rounds or (2 if options.quick else 9)
        results, ratios, targets = measure(trainer, sizes["steps"], rounds)
    finally:
        shutil.rmtree(folder)
    report(
        "train_step",
        settings={
            **sizes,
            "train_head": trainer.params.model_dump(mode="json", exclude={"output", "logs"}),
        },
        results=results,
        ratios=ratios,
        targets=targets,
        quick=options.quick,
        device=str(trainer.device),
    )


def make_trainer(folder: Path, sizes: dict[str, int], device: str, quick: bool) -> Trainer:
    """A trainer of the default head on a new store below `folder`."""
    streams: dict[str, Any] = {name: size for name, size in sizes.items() if name != "steps"}
    store = FeatureStore.open(write_store(folder / "steps.zarr", dtype="float32", **streams))
    changed = {"device": device, "output": folder / "head", "logs": folder / "logs"}
    given = load_params(Path("params.yaml")).train_head.model_dump()
    params = TrainHeadParams.model_validate(given | changed | (SMALL if quick else {}))
    split = split_by_episode(store, params.split, params.horizon)
    return Trainer(store, params, split, TrainingRun(params.output, "new", (), {}))


def measure(
    trainer: Trainer, steps: int, rounds: int
) -> tuple[dict[str, Any], dict[str, Any], list[dict[str, Any]]]:
    """Steps with the feed against steps with batches that are in RAM."""
    windows, device = Windows.of(trainer.params), trainer.device
    with Prefetch(trainer.store, trainer.plan.parts_of(_ENDLESS), windows, device) as feed:
        contenders = {
            FEED: Contender(trainer, feed, steps),
            RAM: Contender(trainer, None, steps),
        }
        work: dict[str, Work] = {name: one.run for name, one in contenders.items()}
        found = race(work, rounds)
    samples = steps * trainer.params.batch_size
    results: dict[str, Any] = found.results({"steps": steps, "samples": samples})
    share = statistics.median(contenders[FEED].wait_shares[1:])
    results[FEED]["wait_share"] = share
    targets = [
        at_most(f"{FEED}: share of the step spent waiting", share, 0.02),
        at_least(f"{FEED}: samples/s against batches in RAM", found.speed(FEED, RAM), 0.95),
    ]
    return results, found.ratios(RAM), targets


def _kept(trainer: Trainer, steps: int) -> Iterator[tuple[BatchIndices, Batch]]:
    """The batches of the first steps, again and again, each taken to the device when asked for."""
    windows = Windows.of(trainer.params)
    sizes = (windows.horizon, windows.sensor_window, windows.state_window)
    kept: list[tuple[BatchIndices, Batch]] = []
    for draw in trainer.plan.parts_of(range(steps)):
        batch = trainer.store.gather(draw.ticks, *sizes, variants=draw.variants)
        kept.append((draw, batch.pin() if trainer.device.type == "cuda" else batch))
    for draw, batch in itertools.cycle(kept):
        yield draw, batch.to(trainer.device, non_blocking=True)


if __name__ == "__main__":
    main()
