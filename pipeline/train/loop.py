"""The one training loop: every expert, cached or live, on one process or several."""

from collections.abc import Callable, Iterator
from itertools import islice

import torch
from torch import nn
from tqdm import tqdm

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import NumericsError
from pipeline.policy.policy import Policy
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices, Windows, choose_feed
from pipeline.train.checkpoints import Checkpoints, read_last
from pipeline.train.feature_source import Cached, FeatureSource
from pipeline.train.history import History
from pipeline.train.identity import policy_shape
from pipeline.train.interrupt import deferred_interrupt
from pipeline.train.judging import EarlyStopping, held_out_error, judged_ticks
from pipeline.train.learner import Learner
from pipeline.train.log import Row, TrainingLog, open_log
from pipeline.train.optimizer import schedule
from pipeline.train.plan import Plan
from pipeline.train.progress import Progress
from pipeline.train.run import Run
from pipeline.train.speed import Speed
from pipeline.train.split import Split
from pipeline.train.state import TrainerState
from pipeline.train.statistics import fit_normalization
from pipeline.train.summary import closing, data_warnings, describe_data, describe_learner
from pipeline.train.world import World, process_device

LOG_EVERY = 10


class Trainer:
    """A policy in training: begins anew or goes on from the run's last checkpoint.

    What a step does follows from the seed and its number alone (its ticks, its dropout, its noise,
    its learning rate), so that a run that was stopped at any checkpoint continues, on a CPU with as
    many threads, to the same losses and weights bit for bit; and N processes, each with its parts
    of every step, follow the curve of one that accumulates N times as much, within float noise.
    Within a `process_group` every process makes one, and all call the same methods.
    """

    def __init__(
        self,
        store: FeatureStore,
        params: TrainHeadParams,
        split: Split,
        run: Run,
        front: FeatureSource | None = None,
    ) -> None:
        self.store, self.params, self.split, self.run = store, params, split, run
        self.world = World.current()
        self.device = process_device(params.device)
        self._feed_note: list[str] = []
        if front is None:
            chosen = choose_feed(params.feed, store, self.device)
            self._feed_note = [chosen.why]
            front = Cached(store, chosen.on_device)
        self.front = front
        self.plan = Plan(store, params, split, self.world, run.section)
        self.step = 0
        self.standing = EarlyStopping.of(params, split)
        self.history = History()
        self._earlier: tuple[Row, ...] = ()
        self._trained_s = 0.0
        state: TrainerState | None = None
        if run.status == "resumed":
            self.normalization, self.shape, state = read_last(run, self.world)
        else:
            self.normalization = self.world.shared(lambda: fit_normalization(store, split.train))
            self.shape = policy_shape(store, self.normalization)
        torch.manual_seed(params.seed)
        policy = Policy(params, self.shape, self.normalization)
        self.learner = Learner(self.front, policy, store, params, self.device, self.world)
        self._checkpoints = Checkpoints(
            run, store, params, split, self.front, self.normalization, self.shape
        )
        if state is not None:
            self._restore(state)

    @property
    def policy(self) -> Policy:
        """The policy in training."""
        return self.front.policy_of(self.learner.module)

    @property
    def averaged(self) -> nn.Module:
        """The module with the averaged weights, which is judged and kept."""
        return self.learner.average.module

    def fit(self) -> None:
        """Train to the last step, or until nothing gets better, and finish the run.

        Raises `NumericsError` on a loss or gradient that is not finite, naming the step and its
        ticks. On Ctrl-C or SIGTERM, to whichever process, all end the step, the last checkpoint is
        written and `KeyboardInterrupt` raised.
        """
        steps = range(self.step, self.params.max_steps)
        windows, resumed = Windows.of(self.params), self.run.status == "resumed"
        with (
            deferred_interrupt() as interrupted,
            open_log(self.params, resumed, self._earlier, self.world) as log,
            self.front.feed(self.plan.draws(steps), windows, self.device) as feed,
            Progress(self.step, self.params.max_steps, self.world.first) as progress,
        ):
            self.world.shared(self.run.begin)
            batches, speed = iter(feed), Speed(feed, self.device, self.step, self._trained_s)
            while not self._over:
                stopped = self._train_step(batches, interrupted)
                progress.advance(self._loss)
                self._after_step(log, speed, progress, stopped)
                if stopped and not self._over:
                    raise KeyboardInterrupt
        self.world.shared(self.run.finish)
        self.world.say(*closing(self.step, self.standing, speed.trained_s, self.device))

    def summary(self) -> list[str]:
        """What is trained, from what and on what, as lines for the user."""
        several = f" on {self.world.size} processes" if self.world.size > 1 else ""
        precision = "bfloat16 autocast" if self.learner.bfloat16 else "float32"
        return [
            *describe_data(self.store, self.shape, self.params, self.split),
            *describe_learner(self.learner, self.policy),
            *self._feed_note,
            f"device {self.device}{several}, {precision}"
            f"{', compiled' if self.params.compile else ''}; "
            f"steps {self.step} to {self.params.max_steps}",
            *data_warnings(self.store, self.shape, self.params, self.split),
        ]

    @property
    def _over(self) -> bool:
        return self.step == self.params.max_steps or self.standing.exhausted

    def _train_step(
        self, batches: Iterator[tuple[BatchIndices, Batch]], interrupted: Callable[[], bool]
    ) -> bool:
        """One step of all processes; whether one of them was told to stop."""
        parts = islice(batches, len(self.plan.own))
        scalars, stopped = self.learner.step(self.step, parts, interrupted)
        self.history.add(scalars)
        self.step += 1
        return stopped

    def _after_step(
        self, log: TrainingLog | None, speed: Speed, progress: Progress, stopped: bool
    ) -> None:
        if self.step % self.params.eval_every == 0 or self._over:
            self._evaluate(log, speed)
        if self.step % LOG_EVERY == 0 or self._over:
            self._write_down(log, speed, progress)
        if self.step % self.params.checkpoint_every == 0 or self._over or stopped:
            self._save_last(log, speed)

    def _write_down(self, log: TrainingLog | None, speed: Speed, progress: Progress) -> None:
        self._check_finite()
        means = self.history.mean((self.step - 1) // LOG_EVERY * LOG_EVERY, self.step)
        rate = self.params.lr * schedule(self.step - 1, self.params)

        def write() -> None:
            assert log is not None
            pace = speed.read(self.step)
            log.write(self.step, {f"train/{k}": v for k, v in means.items()} | {"lr": rate})
            log.write_speed(self.step, pace)
            memory, waited = f"{pace.peak_memory / 2**30:.1f}G", f"{pace.data_wait_share:.0%}"
            loss = f"{means['loss']:.4f}"
            progress.note(loss=loss, lr=f"{rate:.1e}", wait=waited, mem=memory)

        self.world.shared(write)

    def _evaluate(self, log: TrainingLog | None, speed: Speed) -> None:
        """Judge the averaged weights; save them where they are the best so far."""
        self._check_finite()
        with speed.paused():
            metrics = self.world.shared(lambda: self._judge(log))
            if not metrics or self.standing.take(metrics["val/error"]):
                self.world.shared(
                    lambda: self._checkpoints.save_best(self.averaged, self.step, metrics)
                )

    def _judge(self, log: TrainingLog | None) -> dict[str, float]:
        """The held-out metrics, written down and said; none where nothing is held out."""
        assert log is not None
        ticks = judged_ticks(self.split.held_out, self.front)
        if not len(ticks):
            return {}
        metrics = held_out_error(
            self.averaged, self.front, self.store, ticks, self.params, self.normalization
        )
        log.write(self.step, metrics)
        error = metrics["val/error"]
        tqdm.write(
            f"step {self.step}: train loss {self.history.last('loss'):.4f}, held-out error "
            f"{error:.4f} of the training std"
            + (" (best so far)" if self.standing.improves(error) else "")
        )
        return metrics

    def _loss(self) -> float:
        """The loss of the newest step."""
        self._check_finite()
        return self.history.last("loss")

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

    def _save_last(self, log: TrainingLog | None, speed: Speed) -> None:
        self._check_finite()

        def save() -> None:
            assert log is not None
            metrics = {"train/loss": self.history.last("loss")}
            state = self._state(tuple(log.rows), speed.trained_s)
            self._checkpoints.save_last(self.averaged, metrics, state)

        with speed.paused():
            self.world.shared(save)

    def _state(self, rows: tuple[Row, ...], trained_s: float) -> TrainerState:
        return TrainerState(
            step=self.step,
            **self.learner.tensors(),
            history=self.history.tensor(),
            columns=self.history.columns,
            best_error=self.standing.best_error,
            stalled=self.standing.stalled,
            trained_s=trained_s,
            rows=rows,
        )

    def _restore(self, state: TrainerState) -> None:
        self.learner.restore(state, self.run.last)
        self.history = History.of(state.columns, state.history)
        self.standing.best_error, self.standing.stalled = state.best_error, state.stalled
        self.step, self._earlier, self._trained_s = state.step, state.rows, state.trained_s
