"""The one training loop: every expert, cached or live features."""

import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn
from tqdm import tqdm

from pipeline.base.config import TrainHeadParams
from pipeline.base.differences import describe, differences
from pipeline.base.documents import Document, Text
from pipeline.base.errors import CheckpointMismatch, ConfigError, NumericsError
from pipeline.base.files import read_document, read_tensors, sync, write_tensors, write_with_digest
from pipeline.base.hardware import resolve_device, use_bfloat16
from pipeline.base.text import duration, size
from pipeline.policy.checkpoint import PolicyCheckpoint, Sha256, load_policy, save_policy
from pipeline.policy.policy import Policy, Trainable, describe_size
from pipeline.store import Batch, FeatureStore, check_trailers
from pipeline.train.batches import BatchIndices, FeatureSource, Windows, evenly
from pipeline.train.log import History, Row, TrainingLog, check_loggers, open_log
from pipeline.train.optimizer import (
    WeightAverage,
    make_optimizer,
    optimizer_tensors,
    restore_optimizer,
    schedule,
    trainable,
)
from pipeline.train.predictions import predict
from pipeline.train.progress import Progress, describe_data, peak_memory_bytes
from pipeline.train.run import (
    TRAINER_DOCUMENT,
    TRAINER_WEIGHTS,
    TrainingRun,
    open_run,
    policy_shape,
    run_lock,
)
from pipeline.train.sampling import Plan, StepPart
from pipeline.train.scores import action_space, compare
from pipeline.train.split import Split, split_by_episode
from pipeline.train.statistics import anchored_channels, fit_normalization, fit_relative
from pipeline.train.training_data import refuse_tuned_episodes, source_of, split_parts

LOG_EVERY = 10
EVALUATION_TICKS = 1000
"""The most val ticks, evenly spaced, of an evaluation in training; `stages.evaluate` uses all."""


class Trainer:
    """Trains a policy, from the start or from the run's last checkpoint.

    The seed and the step's number alone decide its ticks, dropout, noise and learning rate. So a
    run that was stopped at any checkpoint continues to the same losses and weights, bit for bit on
    a CPU with the same number of threads.
    """

    def __init__(
        self,
        store: FeatureStore,
        params: TrainHeadParams,
        split: Split,
        run: TrainingRun,
        source: FeatureSource | None = None,
    ) -> None:
        self.store, self.params, self.split, self.run = store, params, split, run
        self.device = resolve_device(params.device)
        self.source = source or FeatureSource(store)
        self.golden = self.source.golden  # read now: a damaged row stops a run before it begins
        self.plan = Plan(store, params, split, run.section)
        self.windows = Windows.of(params)
        self.step = 0
        if params.early_stopping is not None and not len(split.val):
            raise ConfigError(
                f"train_head.early_stopping is {params.early_stopping}, but nothing is held out "
                f"that could stop getting better: train_head.split.val is {params.split.val:g}. "
                "Set it above 0, or train_head.early_stopping=null."
            )
        self.stopping = EarlyStopping(params.early_stopping)
        self.history = History()
        self._earlier: Sequence[Row] = ()
        self._trained_s = 0.0
        if run.status == "resumed":
            checkpoint = load_policy(run.last)
            self.normalization, self.shape = checkpoint.normalization, checkpoint.shape
            state, tensors = read_trainer(run.last)
            self._build()
            load_weights(self.learning, of_kind(tensors, "weights"), run.last)
            load_weights(self.average.weights, of_kind(tensors, "average"), run.last)
            restore_optimizer(self.optimizer, self.module, of_kind(tensors, "optimizer"))
            self.history = History(state.columns, tensors["history:"])
            self.stopping.best_error, self.stopping.stalled = state.best_error, state.stalled
            self.step, self._earlier, self._trained_s = state.step, state.rows, state.trained_s
        else:
            # Statistics are of the state encoder's own window; anchoring may gather a longer one.
            readings = min(params.state_window, self.windows.state_window)
            own = {"state_window": readings, "state_window_s": params.state_window_s}
            self.normalization = fit_normalization(store, split.train, replace(self.windows, **own))
            anchored = anchored_channels(store, split.train, params)
            form, history = params.action_form, params.feature_history
            self.shape = policy_shape(store, self.normalization, anchored, form, history)
            relative = fit_relative(store, split.train, self.windows, self.shape)
            self.normalization = replace(self.normalization, relative=relative)
            self._build()

    def _build(self) -> None:
        """Build the module that is trained, its optimizer and the average of its weights."""
        params = self.params
        torch.manual_seed(params.seed)
        policy = Policy(params, self.shape, self.normalization)
        self.module = self.source.attach(policy).to(self.device).train()
        self.learning = trainable(self.module)
        """The parameters that learn, by name; the others are neither averaged nor saved."""
        self.optimizer = make_optimizer(self.module, params, self.source.parameter_lr)
        self.average = WeightAverage(self.module, params.ema_decay)
        self._bfloat16 = use_bfloat16(params.amp, self.device)

    @property
    def policy(self) -> Policy:
        """The policy in training."""
        return self.source.policy_of(self.module)

    @property
    def averaged(self) -> Trainable:
        """The module with the averaged weights, which is evaluated and saved."""
        assert isinstance(self.average.module, Trainable)
        return self.average.module

    def fit(self) -> None:
        """Train to the last step or to an early stop, and finish the run.

        Raises `NumericsError` on a loss or gradient that is not finite, naming the step and its
        ticks. On Ctrl-C or SIGTERM it finishes the step, writes the last checkpoint and raises
        `KeyboardInterrupt`.
        """
        steps, resumed = range(self.step, self.params.max_steps), self.run.status == "resumed"
        with (
            deferred_interrupt() as interrupted,
            open_log(self.params, resumed, self._earlier) as log,
            self.source.feed(self.plan.parts_of(steps), self.windows, self.device) as feed,
            Progress(feed, self.device, steps, self._trained_s) as progress,
        ):
            self.run.begin()
            batches = iter(feed)
            while not self._over:
                self._train_step(batches)
                stopped = interrupted()
                progress.advance()
                if self.step % self.params.eval_every == 0 or self._over:
                    self._evaluate(log, progress)
                if self.step % LOG_EVERY == 0 or self._over:
                    self._write_down(log, progress)
                if self.params.keep_every and self.step % self.params.keep_every == 0:
                    self._check_finite()
                    with progress.paused():
                        self._save(self.run.kept(self.step), self._losses)
                if self.step % self.params.checkpoint_every == 0 or self._over or stopped:
                    self._save_last(log, progress)
                if stopped and not self._over:
                    raise KeyboardInterrupt
        self.run.finish()
        if self.stopping.exhausted:
            stalled = self.stopping.stalled
            print(f"stopped early at step {self.step}: {stalled} evaluations without a better one")
        print(
            f"trained {self.step} steps in {duration(progress.trained_s)} "
            f"({self.step / max(progress.trained_s, 1e-9):.1f} steps/s), "
            f"peak memory {size(peak_memory_bytes(self.device))}"
        )

    def summary(self) -> list[str]:
        """Lines for the user: what is trained, from what data and on which device."""
        lines = [describe_size(self.policy)]
        if self.module is not self.policy:
            table = ", ".join(f"{part} {n:,}" for part, n in self.module.parameter_table())
            lines.append(f"parameters with what is before it: {table}")
        learning = sum(value.numel() for value in self.learning.values())
        whole = sum(value.numel() for value in self.module.parameters())
        if learning < whole:
            lines.append(f"learns {learning:,} of {whole:,} parameters")
        precision = "bfloat16 autocast" if self._bfloat16 else "float32"
        return [
            *lines,
            f"device {self.device}, {precision}; steps {self.step} to {self.params.max_steps}",
            *self.source.summary(),
            *describe_data(self.store, self.shape, self.params, self.split),
        ]

    @property
    def _over(self) -> bool:
        return self.step == self.params.max_steps or self.stopping.exhausted

    def _train_step(self, batches: Iterator[tuple[BatchIndices, Batch]]) -> None:
        self.history.add(self.learn(islice(batches, self.params.grad_accumulation)))
        self.step += 1

    def learn(self, parts: Iterable[tuple[BatchIndices, Batch]]) -> dict[str, Tensor]:
        """Learn from the parts of the next step's batch.

        Returns the loss, the norm of the gradient and the loss's parts, detached.
        """
        share = schedule(self.step, self.params)
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak_lr"] * share
        self.optimizer.zero_grad(set_to_none=True)
        scalars: dict[str, Tensor] = {}
        for part, batch in parts:
            for name, value in self._backward(part, batch).items():
                scalars[name] = scalars[name] + value if name in scalars else value
        norm = torch.nn.utils.clip_grad_norm_(self.learning.values(), self.params.grad_clip)
        self.optimizer.step()
        self.average.update(self.step + 1)
        return {"loss": scalars.pop("loss"), "grad_norm": norm, **scalars}

    def _backward(self, part: BatchIndices, batch: Batch) -> dict[str, Tensor]:
        """Add a part's gradients; returns its loss and the loss's parts, times its share."""
        assert isinstance(part, StepPart), "a feed hands back the entries of its plan"
        # A part's dropout and sampled noise must not depend on the parts before it.
        torch.manual_seed(part.seed)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._bfloat16):
            loss, parts = self.module.loss(batch, batch.action, batch.action_valid)
        loss = loss * part.share
        loss.backward()
        return {"loss": loss.detach()} | {name: part.share * v for name, v in parts.items()}

    def _write_down(self, log: TrainingLog, progress: Progress) -> None:
        self._check_finite()
        means = self.history.mean((self.step - 1) // LOG_EVERY * LOG_EVERY, self.step)
        rate = self.params.lr * schedule(self.step - 1, self.params)
        log.write(self.step, {f"train/{k}": v for k, v in means.items()} | {"lr": rate})
        progress.show(means["loss"], rate)

    def _evaluate(self, log: TrainingLog, progress: Progress) -> None:
        """Evaluate the averaged weights; save them where they are the best so far."""
        self._check_finite()
        with progress.paused():
            metrics = self._measure(log)
            best = not metrics or self.stopping.take(metrics["val/error"])
            if metrics:
                tqdm.write(
                    f"step {self.step}: train loss {self.history.last('loss'):.4f}, val error "
                    f"{metrics['val/error']:.4f} of the training std"
                    f"{' (best so far)' if best else ''}"
                )
            if best:
                self._save(self.run.best, metrics)

    def _measure(self, log: TrainingLog) -> dict[str, float]:
        """Log and return the metrics on val; none where val is empty. Test is never read.

        `val/error` is in training standard deviations, without dimensions that hardly move;
        `val/<group>` is in the group's unit.
        """
        ticks = evenly(self.split.val, self.source.eval_ticks or EVALUATION_TICKS)
        if not len(ticks):
            return {}
        predictions = predict(
            self.averaged,
            self.store,
            ticks,
            self.windows,
            self.params.batch_size,
            feed=lambda plan: self.source.feed(plan, self.windows, self.device),
        )
        comparison = compare(predictions, {}, action_space(self.store, self.normalization))
        # A joint that stands still in training, and elsewhere in val, would choose the checkpoint.
        error = comparison.without_low_variance().overall("policy")
        metrics = {"val/error": error} | {
            f"val/{group.key}": comparison.error("policy", group) for group in comparison.groups
        }
        log.write(self.step, metrics)
        return metrics

    def _check_finite(self) -> None:
        bad = self.history.settle()
        if bad is not None:
            last = self.run.last
            kept = f" {last} holds the run as it was before." if last.exists() else ""
            raise NumericsError(
                f"step {bad + 1}: expected a finite loss and gradient, found "
                f"{self.history.describe(bad)}. Its ticks in {self.store.path}: "
                f"{self.plan.ticks(bad).tolist()}. Look at these recordings, lower "
                f"{self.run.section}.lr or train_head.grad_clip.{kept}"
            )

    def _save_last(self, log: TrainingLog, progress: Progress) -> None:
        """Save the newest weights and the trainer's state."""
        self._check_finite()
        tensors = {"history:": self.history.tensor()}
        for kind, named in (
            ("weights", self.learning),
            ("average", self.average.weights),
            ("optimizer", optimizer_tensors(self.optimizer, self.module)),
        ):
            tensors |= {f"{kind}:{name}": value for name, value in named.items()}
        state = {
            "step": self.step,
            "columns": self.history.columns,
            "best_error": self.stopping.best_error,
            "stalled": self.stopping.stalled,
            "trained_s": progress.trained_s,
            "rows": log.rows,
        }
        write_state = partial(write_trainer, state=state, tensors=tensors)
        with progress.paused():
            self._save(self.run.last, self._losses, write_state)

    @property
    def _losses(self) -> dict[str, float]:
        return {"train/loss": self.history.last("loss")}

    def _save(
        self,
        folder: Path,
        metrics: Mapping[str, float],
        write_state: Callable[[Path], None] = lambda folder: None,
    ) -> None:
        """Save the averaged weights as a checkpoint folder. Raises `DiskFull`."""
        checkpoint = PolicyCheckpoint(
            params=self.params,
            shape=self.shape,
            normalization=self.normalization,
            source=source_of(self.store),
            instructions=tuple(sorted({episode.instruction for episode in self.store.episodes})),
            split=split_parts(self.store, self.split),
            step=self.step,
            weights=self.source.policy_of(self.averaged).state_dict(),
            metrics=metrics,
            golden=self.golden,
            basis=self.store.basis,
        )

        def write_beside(temporary: Path) -> None:
            self.source.save(temporary, self.averaged)
            for path in temporary.rglob("*"):
                sync(path)
            write_state(temporary)

        save_policy(folder, checkpoint, beside=write_beside)


def train(
    store: FeatureStore,
    params: TrainHeadParams,
    source: FeatureSource | None = None,
    section: str = "train_head",
) -> None:
    """Begin, continue or leave the run of these params on this store, and print what is done.

    `section` is the section of the params that errors name.
    """
    check_loggers(params)
    identity = {} if source is None else source.identity
    with run_lock(params):
        run = open_run(params, store, identity, section)
        _say(run.notes)
        if run.status == "finished":
            print("nothing to do")
            return
        if params.check_store:
            check_trailers(store.path)
        split = split_by_episode(store, params.split, params.horizon)
        _say(refuse_tuned_episodes(store, split))
        trainer = Trainer(store, params, split, run, source)
        _say(trainer.summary())
        trainer.fit()
    print(f"best and last checkpoint: {run.output}; curves: {params.logs}")


def _say(lines: Iterable[str]) -> None:
    for line in lines:
        print(line, flush=True)


@dataclass
class EarlyStopping:
    """The best error on val so far, and the evaluations since."""

    patience: int | None
    """A run ends after so many evaluations without a better one; with None it never does."""
    best_error: float | None = None
    stalled: int = 0

    def take(self, error: float) -> bool:
        """Count the error of an evaluation; returns whether it is the best so far."""
        better = self.best_error is None or error < self.best_error
        if better:
            self.best_error = error
        self.stalled = 0 if better else self.stalled + 1
        return better

    @property
    def exhausted(self) -> bool:
        """Whether the run ends here."""
        return self.patience is not None and self.stalled >= self.patience


@contextmanager
def deferred_interrupt() -> Generator[Callable[[], bool]]:
    """Within it, the first SIGINT or SIGTERM only makes the yielded function return True.

    A step stopped half-way would leave some weights updated and others not, so the loop asks
    between steps. A second signal raises `KeyboardInterrupt` at once. Outside the main thread,
    where Python delivers no signal, it changes nothing.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(signum: int, frame: FrameType | None) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(signum)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class TrainerState(Document):
    """A run after `step` steps, as in `trainer.json`.

    It has no random state and no schedule state: both follow from the seed and the step.
    """

    step: Annotated[int, Field(ge=0)]
    columns: tuple[Text, ...]
    """Column names of the history."""
    best_error: float | None
    stalled: Annotated[int, Field(ge=0)]
    """Evaluations since the best one."""
    trained_s: Annotated[float, Field(ge=0)]
    """Seconds of training so far, over all starts."""
    rows: tuple[tuple[int, dict[Text, float]], ...]
    weights_sha256: Sha256


def write_trainer(folder: Path, state: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Write the two files of a trainer's state into an existing folder.

    `state` has the fields of `TrainerState` except the digest. `tensors` are the trainable
    parameters (`weights:<name in the trained module>`), their moving averages (`average:`), the
    optimizer's state (`optimizer:`), and a row for every step so far (`history:`).
    """
    digest = write_tensors(folder / TRAINER_WEIGHTS, tensors)
    write_with_digest(folder / TRAINER_DOCUMENT, {**state, "weights_sha256": digest})


def read_trainer(folder: Path) -> tuple[TrainerState, dict[str, Tensor]]:
    """The state at `folder`. Raises `CheckpointIncomplete` where a file is missing or damaged."""
    state, _ = read_document(folder / TRAINER_DOCUMENT, TrainerState)
    return state, read_tensors(folder / TRAINER_WEIGHTS, state.weights_sha256)


def of_kind(tensors: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
    """The tensors of one kind, by name."""
    kind += ":"
    return {k.removeprefix(kind): value for k, value in tensors.items() if k.startswith(kind)}


@torch.no_grad()
def load_weights(
    parameters: Mapping[str, nn.Parameter], tensors: Mapping[str, Tensor], place: Path
) -> None:
    """Copy the tensors into the parameters of the same names.

    Raises `CheckpointMismatch` where names or shapes differ.
    """
    wanted = {name: tuple(value.shape) for name, value in parameters.items()}
    stored = {name: tuple(value.shape) for name, value in tensors.items()}
    if differing := describe(differences(stored, wanted)):
        raise CheckpointMismatch(
            f"{place}: expected what learns in this run, {len(wanted)} parameters; {differing[0]} "
            f"(the checkpoint -> the run). Remove {place} to begin anew, or use the version of "
            "this code that wrote it."
        )
    for name, parameter in parameters.items():
        parameter.copy_(tensors[name])
