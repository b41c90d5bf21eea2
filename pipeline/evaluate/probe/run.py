"""Every slot and every group of slots, scored by what a linear reader finds in it."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import NoReturn, TypeVar

import torch
from tqdm import tqdm

from pipeline.base.config import ProbeParams
from pipeline.base.errors import StoreMismatch
from pipeline.evaluate.probe.accumulation import Table
from pipeline.evaluate.probe.effort import foretold
from pipeline.evaluate.probe.folds import Folds, fold_by_recording
from pipeline.evaluate.probe.moments import Moments
from pipeline.evaluate.probe.readers import Reader, SlotName, fit_reader, groups_of, slot_names
from pipeline.evaluate.probe.ridge import Score, Scores, cross_validate
from pipeline.evaluate.probe.summaries import summarize
from pipeline.store import FeatureStore

_Result = TypeVar("_Result")

MEMORY_BYTES = 2**30
"""Of sums at a time; as many slots share a pass over the rows as fit."""
_OTHER_STEPS = 2
"""Of each reader, beside a pass over every part: what it is fitted on, and its regressions."""
_RUN_BYTES = 16 * 2**10
"""Of a row that one thread reads at least: several pages, so that few are read twice."""


@dataclass(frozen=True, eq=False)
class Finding:
    """What is found in a slot or a group of slots; a score is None where too few folds have it."""

    name: SlotName
    slots: tuple[int, ...]
    channels: int
    """Of all its slots together."""
    inputs: int
    """That the reader had of them."""
    valid_share: float
    """Of the ticks."""
    alone: Score | None
    beside: Score | None
    """With state + sensor."""
    without: Score | None
    """State + sensor alone, on the same ticks."""

    @property
    def best(self) -> Score | None:
        """What it is ranked by: beside state + sensor, where there are any."""
        return self.beside or self.alone

    @property
    def gain(self) -> float | None:
        """What it adds to state + sensor."""
        if self.beside is None or self.without is None:
            return None
        return self.beside.mean - self.without.mean


@dataclass(frozen=True, eq=False)
class Study:
    """All findings, and what they are measured against."""

    horizon: int
    action_names: tuple[str, ...]
    folds: Folds
    mean_action: Score
    streams: Score | None
    """State + sensor alone; None where the store has neither."""
    stream_inputs: int
    slots: tuple[Finding, ...]
    """In the store's order."""
    groups: tuple[Finding, ...]


@dataclass(frozen=True)
class _Task:
    name: SlotName
    slots: tuple[int, ...]


def probe(
    store: FeatureStore, params: ProbeParams, say: Callable[[str], None] = lambda _: None
) -> Study:
    """Ridge regression from every slot of variant 0 to the action chunk, cross-validated.

    Alone, and beside the last, mean and spread of the causal windows of state and sensor; each slot
    by itself and each choice of layer, norm and pooling as a whole. Folds hold whole recordings, so
    nothing that tells a recording from another helps. A slot is read once, or twice where its group
    has more of them; memory grows with the square of the inputs, not with the rows. The same store
    and params give the same bits, whatever the threads. `say` is told what is to be done before
    the long part of it; a bar shows it on a terminal.

    Raises `StoreMismatch` where fewer than two recordings are long enough, and `NumericsError` on
    NaN or inf, naming the place.
    """
    folds = fold_by_recording(store, params.folds, params.horizon, params.max_ticks)
    with _one_thread_each():
        summaries = summarize(
            store, folds.ticks, folds.fold, params.sensor_window, params.state_window
        )
        table = Table(store, folds, summaries, params.horizon)
        names = slot_names(store)
        singles = [_Task(name, (index,)) for index, name in enumerate(names)]
        groups = [_Task(name, slots) for name, slots in groups_of(names).items()]
        several = [task for task in groups if len(task.slots) > 1]
        sizes = [len(task.slots) for task in (*singles, *several)]
        say(foretold(table, sizes, len(params.penalties), params.threads))
        steps = len(sizes) * (len(folds.fold_of_part) + _OTHER_STEPS)
        with tqdm(total=steps, desc="probing", unit="step", leave=False, disable=None) as bar:
            work = _Work(table, params, bar)
            mean_action, streams = work.baselines()
            found = work.findings(singles)
            of_group = {one.name: one for task in several for one in work.findings([task])}
    alone = {one.name.group: one for one in found}
    return Study(
        horizon=params.horizon,
        action_names=tuple(store.streams["action"]["names"]),
        folds=folds,
        mean_action=mean_action,
        streams=streams,
        stream_inputs=table.beside,
        slots=tuple(found),
        groups=tuple(of_group.get(task.name) or alone[task.name] for task in groups),
    )


class _Work:
    """The passes over the rows and the regressions, shared out among threads."""

    def __init__(self, table: Table, params: ProbeParams, bar: "tqdm[NoReturn]") -> None:
        self._table = table
        self._params = params
        self._bar = bar
        self._parts = range(len(table.folds.fold_of_part))
        self._streams: Score | None = None

    def baselines(self) -> tuple[Score, Score | None]:
        """The mean action, and state + sensor alone."""
        parts = [self._table.moments(part, [Reader((), ())])[0] for part in self._parts]
        mean_action = self._known([part.last(self._table.targets) for part in parts])
        if mean_action is None:
            raise StoreMismatch(
                "too few ticks to hold recordings out in turn: a fold, or what it would train on, "
                "has none. Give a store with more or longer recordings, a larger probe.max_ticks "
                "or a smaller probe.horizon."
            )
        if self._table.beside:
            self._streams = self._known(parts)
        return mean_action, self._streams

    def findings(self, tasks: Sequence[_Task]) -> list[Finding]:
        """Of each, in order; those that fit into memory together share a pass."""
        columns = self._table.store.feature_shape[1] + self._table.beside + self._table.targets
        room = max(1, MEMORY_BYTES // (8 * columns**2 * len(self._parts)))
        found = []
        for first in range(0, len(tasks), room):
            some = tasks[first : first + room]
            readers = self._in_order([partial(self._reader, task) for task in some])
            sums = self._accumulated(readers)
            found += self._in_order(
                [
                    partial(self._finding, task, reader, parts)
                    for task, reader, parts in zip(some, readers, sums, strict=True)
                ]
            )
        return found

    def _reader(self, task: _Task) -> Reader:
        table = self._table
        reader = fit_reader(table.store, table.rows, table.row_fold, task.slots)
        self._bar.update()
        return reader

    def _summed(self, part: int, readers: Sequence[Reader]) -> list[Moments]:
        moments = self._table.moments(part, readers)
        self._bar.update(len(readers))
        return moments

    def _accumulated(self, readers: Sequence[Reader]) -> list[list[Moments]]:
        """The moments of each reader, of each part."""
        features = self._table.store.array("vl/features")
        slot_bytes = features.dtype.itemsize * features.shape[2]
        run = -(-_RUN_BYTES // max(1, slot_bytes))
        runs = [readers[first : first + run] for first in range(0, len(readers), run)]
        by_job = self._in_order(
            [partial(self._summed, part, some) for some in runs for part in self._parts]
        )
        count = len(self._parts)
        by_run = [by_job[first : first + count] for first in range(0, len(by_job), count)]
        return [list(parts) for some in by_run for parts in zip(*some, strict=True)]

    def _finding(self, task: _Task, reader: Reader, parts: Sequence[Moments]) -> Finding:
        beside = self._table.beside
        share = self._table.valid_share(task.slots)
        without = self._streams
        if beside and share < 1:
            without = self._known([part.last(beside + self._table.targets) for part in parts])
        scores = self._scored(parts, beside, without)
        finding = Finding(
            name=task.name,
            slots=task.slots,
            channels=len(task.slots) * self._table.store.feature_shape[1],
            inputs=reader.width,
            valid_share=share,
            alone=None if scores is None else scores.alone,
            beside=None if scores is None else scores.beside,
            without=without,
        )
        self._bar.update()
        return finding

    def _known(self, parts: Sequence[Moments]) -> Score | None:
        """By all columns but the targets; by none, the mean action."""
        scores = self._scored(parts)
        return None if scores is None else scores.alone

    def _scored(
        self, parts: Sequence[Moments], known: int = 0, known_score: Score | None = None
    ) -> Scores | None:
        folds, penalties = self._table.folds.fold_of_part, self._params.penalties
        return cross_validate(parts, folds, self._table.targets, penalties, known, known_score)

    def _in_order(self, jobs: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """The results of the jobs, run on dask's threads."""
        import dask  # here, as most commands never need it

        return list(
            dask.compute(
                *(dask.delayed(job, pure=False)() for job in jobs),
                scheduler="threads",
                num_workers=self._params.threads,
            )
        )


@contextmanager
def _one_thread_each() -> Generator[None]:
    """Linear algebra on the thread that asks: the same bits, whatever the machine's cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
