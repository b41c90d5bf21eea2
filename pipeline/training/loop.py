"""The one training loop."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from tqdm import tqdm

from pipeline.batches import Draw, Prefetch, Windows
from pipeline.checkpoint import (
    PolicyCheckpoint,
    load_policy,
    policy_shape,
    save_policy,
    source_of,
    write_policy,
)
from pipeline.config import TrainHeadParams
from pipeline.device import resolve_device, use_bfloat16
from pipeline.durable import replace_folder
from pipeline.errors import NumericsError
from pipeline.evaluation import held_out_contents, held_out_ranges, judge
from pipeline.models import Policy
from pipeline.sampling import Split, TickSampler, ticks_by_source
from pipeline.store import Batch, FeatureStore
from pipeline.training.ema import WeightAverage
from pipeline.training.history import History
from pipeline.training.interrupt import deferred_interrupt
from pipeline.training.log import Row, Speed, TrainingLog
from pipeline.training.optimizer import (
    learning_rate,
    make_optimizer,
    optimizer_tensors,
    restore_optimizer,
    set_learning_rate,
)
from pipeline.training.run import Run
from pipeline.training.state import TrainerState, read_trainer, write_trainer
from pipeline.training.statistics import fit_normalization
from pipeline.training.summary import describe_data

LOG_EVERY = 10
EVALUATION_TICKS = 1000
"""Held-out ticks judged during training at most, evenly spaced; `stages.evaluate` takes all."""


class Trainer:
    """A policy in training: begins anew or goes on from the run's last checkpoint.

    What a step does follows from the seed and its number alone (its ticks, its dropout, its
    learning rate), so that a run that was stopped at any checkpoint continues, on a CPU with as
    many threads, to the same losses and weights bit for bit.
    """

    def __init__(
        self, store: FeatureStore, params: TrainHeadParams, split: Split, run: Run
    ) -> None:
        self.store, self.params, self.split, self.run = store, params, split, run
        self.device = resolve_device(params.device)
        self.bfloat16 = use_bfloat16(params.amp, self.device)
        self.windows = Windows.of(params)
        self.sampler = TickSampler(
            ticks_by_source(store, split.train), params.mixture, params.batch_size, params.seed
        )
        self.step = 0
        self.best_error: float | None = None
        self.history = History()
        self._earlier: tuple[Row, ...] = ()
        if run.status == "resumed":
            self._restore(load_policy(run.last), read_trainer(run.last))
        else:
            self._begin()

    def fit(self) -> None:
        """Train to the last step and finish the run.

        Raises `NumericsError` on a loss or gradient that is not finite, naming the step and its
        ticks. On Ctrl-C or SIGTERM the step ends, the last checkpoint is written and
        `KeyboardInterrupt` raised.
        """
        self.run.begin()
        with (
            deferred_interrupt() as interrupted,
            TrainingLog(self.params.logs, self._earlier) as log,
            Prefetch(self.store, self._plan(), self.windows, self.device) as batches,
            tqdm(
                initial=self.step, total=self.params.max_steps, unit="step", disable=None
            ) as progress,
        ):
            clock = Speed(batches, self.step)
            for _, batch in batches:
                self._train_step(batch)
                progress.update()
                self._after_step(log, clock, progress)
                if interrupted() and self.step < self.params.max_steps:
                    self._save_last(log)
                    raise KeyboardInterrupt
        self.run.finish()

    def summary(self) -> list[str]:
        """What is trained, from what and on what, as lines for the user."""
        precision = "bfloat16 autocast" if self.bfloat16 else "float32"
        return [
            *describe_data(self.store, self.shape, self.params, self.split),
            "parameters: "
            + ", ".join(f"{part} {count:,}" for part, count in self.policy.parameter_table()),
            f"device {self.device}, {precision}; steps {self.step} to {self.params.max_steps}",
        ]

    def _plan(self) -> Iterator[Draw]:
        steps = range(self.step, self.params.max_steps)
        return (Draw(self.sampler.batch(step)) for step in steps)

    def _train_step(self, batch: Batch) -> None:
        rate = learning_rate(self.step, self.params)
        set_learning_rate(self.optimizer, rate)
        # Dropout and sampled noise of a step depend on nothing that came before it.
        torch.manual_seed(_step_seed(self.params.seed, self.step))
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
            loss, parts = self.policy.loss(batch, batch.action, batch.action_valid)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.params.grad_clip)
        self.optimizer.step()
        self.step += 1
        self.average.update(self.policy, self.step)
        self.history.add({"loss": loss.detach(), "grad_norm": norm, **parts})

    def _after_step(self, log: TrainingLog, clock: Speed, progress: "tqdm[NoReturn]") -> None:
        ends = self.step == self.params.max_steps
        if self.step % LOG_EVERY == 0 or ends:
            self._log(log, clock, progress)
        if self.step % self.params.eval_every == 0 or ends:
            self._evaluate(log)
        if self.step % self.params.checkpoint_every == 0 or ends:
            self._save_last(log)

    def _log(self, log: TrainingLog, clock: Speed, progress: "tqdm[NoReturn]") -> None:
        self._check_finite()
        means = self.history.mean((self.step - 1) // LOG_EVERY * LOG_EVERY, self.step)
        rate = learning_rate(self.step - 1, self.params)
        log.write(self.step, {f"train/{k}": v for k, v in means.items()} | {"lr": rate})
        steps_per_s, waiting = clock.read(self.step)
        log.write_speed(self.step, steps_per_s, waiting)
        progress.set_postfix(loss=f"{means['loss']:.4f}", lr=f"{rate:.1e}", wait=f"{waiting:.0%}")

    def _evaluate(self, log: TrainingLog) -> None:
        """Judge the averaged weights; save them where they are the best so far."""
        self._check_finite()
        ticks = self.split.held_out
        if not len(ticks):
            self._save_best({})
            return
        spread = np.linspace(0, len(ticks) - 1, min(len(ticks), EVALUATION_TICKS)).round()
        comparison, _ = judge(
            self.average.policy,
            self.store,
            ticks[spread.astype(np.int64)],
            self.windows,
            self.params.batch_size,
            self.normalization,
        )
        error = comparison.overall("policy")
        groups = {
            f"val/{group.key}": comparison.group_mae("policy", group) for group in comparison.groups
        }
        log.write(self.step, {"val/error": error, **groups})
        better = self.best_error is None or error < self.best_error
        tqdm.write(
            f"step {self.step}: train loss {self.history.last('loss'):.4f}, held-out error "
            f"{error:.4f} of the training std" + (" (best so far)" if better else "")
        )
        if better:
            self.best_error = error
            self._save_best({"val/error": error, **groups})

    def _check_finite(self) -> None:
        bad = self.history.settle()
        if bad is not None:
            ticks = self.sampler.batch(bad)
            last = self.run.last
            kept = f" {last} holds the run as it was before." if last.exists() else ""
            raise NumericsError(
                f"step {bad + 1}: expected a finite loss and gradient, found "
                f"{self.history.describe(bad)}. Its ticks in {self.store.path}: "
                f"{ticks.tolist()}. Look at these recordings, lower train_head.lr or "
                f"train_head.grad_clip.{kept}"
            )

    def _save_best(self, metrics: Mapping[str, float]) -> None:
        save_policy(self.run.best, self._checkpoint(metrics))

    def _save_last(self, log: TrainingLog) -> None:
        self._check_finite()

        def write(folder: Path) -> None:
            write_policy(folder, self._checkpoint({"train/loss": self.history.last("loss")}))
            write_trainer(
                folder,
                TrainerState(
                    step=self.step,
                    weights=self.policy.state_dict(),
                    optimizer=optimizer_tensors(self.optimizer, self.policy),
                    history=self.history.tensor(),
                    columns=self.history.columns,
                    best_error=self.best_error,
                    rows=tuple(log.rows),
                ),
            )

        replace_folder(self.run.last, write)

    def _checkpoint(self, metrics: Mapping[str, float]) -> PolicyCheckpoint:
        ranges = held_out_ranges(self.store, self.split.held_out)
        return PolicyCheckpoint(
            params=self.params,
            shape=self.shape,
            normalization=self.normalization,
            source=source_of(self.store),
            held_out_ticks=ranges,
            held_out_content=held_out_contents(self.store, ranges),
            step=self.step,
            weights=self.average.policy.state_dict(),
            metrics=metrics,
        )

    def _begin(self) -> None:
        torch.manual_seed(self.params.seed)
        self.normalization = fit_normalization(self.store, self.split.train)
        self.shape = policy_shape(self.store, self.normalization)
        self._build(Policy(self.params, self.shape, self.normalization))

    def _restore(self, checkpoint: PolicyCheckpoint, state: TrainerState) -> None:
        self.normalization, self.shape = checkpoint.normalization, checkpoint.shape
        policy = Policy(self.params, self.shape, self.normalization)
        policy.load_state_dict(dict(state.weights))
        self._build(policy)
        self.average.policy.load_state_dict(dict(checkpoint.weights))
        restore_optimizer(self.optimizer, self.policy, state.optimizer)
        self.step, self.best_error, self._earlier = state.step, state.best_error, state.rows
        self.history = History.of(state.columns, state.history)

    def _build(self, policy: Policy) -> None:
        self.policy = policy.to(self.device).train()
        self.optimizer = make_optimizer(self.policy, self.params)
        self.average = WeightAverage(self.policy, self.params.ema_decay)


def _step_seed(seed: int, step: int) -> int:
    return int(np.random.SeedSequence((seed, step)).generate_state(1, np.uint64)[0])
