"""What a run prints: its data when it begins, then its progress and speed."""

import resource
import sys
import time
from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from typing import NoReturn

import numpy as np
import torch
from tqdm import tqdm

from pipeline.base.config import TrainHeadParams
from pipeline.base.text import duration, size
from pipeline.policy.observation import PolicyShape
from pipeline.store import FeatureStore
from pipeline.store.proofs import storage_note
from pipeline.train.batches import Prefetch
from pipeline.train.sampling import ticks_by_source
from pipeline.train.split import Split
from pipeline.train.training_data import split_parts

EVERY_S = 60.0
"""Seconds between two lines where there is no terminal."""


class Progress(AbstractContextManager["Progress"]):
    """Counts steps on stderr with a bar, or a line a minute.

    It also measures the pace of the steps and the wait for data; evaluations and checkpoints do not
    count.
    """

    def __init__(
        self,
        feed: Prefetch,
        device: torch.device,
        steps: range,
        trained_s: float = 0.0,
    ) -> None:
        # None: shown where stderr is a terminal.
        self._bar: tqdm[NoReturn] = tqdm(
            initial=steps.start, total=steps.stop, unit="step", disable=None
        )
        self._feed, self._device, self._step, self._total = feed, device, steps.start, steps.stop
        self._last_reading = self._step, trained_s, feed.waited_s
        self._before = trained_s
        self._since: float | None = time.perf_counter()
        self._last_line = self._since

    def advance(self) -> None:
        """Count a step."""
        self._step += 1
        self._bar.update()

    def show(self, loss: float, lr: float) -> None:
        """Show these and the pace since the last call behind the bar.

        Without a bar, print a line if the last is a minute old.
        """
        step, trained, waited = self._last_reading
        self._last_reading = self._step, self.trained_s, self._feed.waited_s
        elapsed = max(self.trained_s - trained, 1e-9)
        steps_per_s = (self._step - step) / elapsed
        self._bar.set_postfix(
            loss=f"{loss:.4f}",
            lr=f"{lr:.1e}",
            wait=f"{(self._feed.waited_s - waited) / elapsed:.0%}",
            mem=f"{peak_memory_bytes(self._device) / 2**30:.1f}G",
        )
        now = time.perf_counter()
        if self._bar.disable and now - self._last_line >= EVERY_S:
            self._last_line = now
            left = duration((self._total - self._step) / steps_per_s)
            print(
                f"step {self._step} of {self._total}: train loss {loss:.4f}, "
                f"{steps_per_s:.3g} steps/s, about {left} left",
                file=sys.stderr,
                flush=True,
            )

    @property
    def trained_s(self) -> float:
        """Seconds of training so far, over all starts of the run."""
        running = 0.0 if self._since is None else time.perf_counter() - self._since
        return self._before + running

    @contextmanager
    def paused(self) -> Generator[None]:
        """Within it, no time is counted as training."""
        self._before, self._since = self.trained_s, None
        yield
        self._since = time.perf_counter()

    def __exit__(self, *raised: object) -> None:
        self._bar.close()


def peak_memory_bytes(device: torch.device) -> int:
    """The most bytes that this process has held: allocated on its GPU, else resident in memory.

    Resident bytes include the mapped pages of the store that are in memory.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def describe_data(
    store: FeatureStore, shape: PolicyShape, params: TrainHeadParams, split: Split
) -> list[str]:
    """Lines for the user on the store, its streams and the split.

    Warnings come last: they name sources and streams of the store that the training episodes lack.
    """
    slots, dim = store.feature_shape
    sides = split_parts(store, split).values()
    groups = [{part.group for part in parts.values()} for parts in sides]
    number = len(set[str]().union(*groups))
    cut = f" ({number} in all, cut by time)" if number < sum(map(len, groups)) else ""
    lines = [
        f"store {store.path}: {len(store.episodes)} episodes, {store.ticks} ticks, "
        f"{slots} x {dim} features a VL row",
        f"split: {len(split.train)} training ticks, {len(split.val)} val, {len(split.test)} test "
        f"of {' + '.join(str(len(names)) for names in groups)} groups{cut}",
    ]
    if store.basis is not None:
        lines.append(
            f"features are on {dim} main directions of {store.spec['pca']['of']} numbers; the "
            f"checkpoint carries their basis, {size(store.basis.maps.nbytes)}"
        )
    if note := storage_note(store.attrs):
        lines.append(note)
    if anchored := shape.anchored(store.streams["action"]["names"]):
        lines.append(f"anchored at the newest frame: {', '.join(anchored)}")
    if not len(split.test):
        lines.append("split: nothing is test, so nothing is left for stages.evaluate to report on")
    if split.note:
        lines.append(f"split: {split.note}")
    lost: list[str] = []
    trained = ticks_by_source(store, split.train)
    for source, ticks in ticks_by_source(store, np.arange(store.ticks)).items():
        if len(ticks) and not len(trained[source]) and params.mixture.get(source, 1) > 0:
            lost.append(f"source {source!r}: none of its episodes is trained on")
    for stream, stored, known, switch in (
        ("sensor", store.sensor_channels, shape.sensor_channels, "sensor_enabled"),
        ("state", store.state_dim, shape.state_dim, "robot_state_enabled"),
        ("features", slots * dim, slots * dim, "features_enabled"),
    ):
        if not stored:
            lines.append(f"{stream}: absent from the store, its encoder is disabled")
        elif not getattr(params, switch):
            lines.append(f"{stream}: disabled by train_head.{switch}")
        elif not known:
            lost.append(f"{stream}: in the store, but absent from the training episodes' windows")
    return lines + [
        f"warning: {what}. Nothing is learnt of it. Groups of episodes are held out by a hash, "
        f"train_head.split val {params.split.val:g} and test {params.split.test:g} of them: set "
        "smaller shares (0 holds none out) or another seed, or extract more episodes with it"
        for what in lost
    ]
