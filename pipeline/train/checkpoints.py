"""The best and the last checkpoint of a run, and the way back from the last."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from torch import nn

from pipeline.base.config import TrainHeadParams
from pipeline.base.durable import sync
from pipeline.policy.checkpoint import PolicyCheckpoint, load_policy, save_policy
from pipeline.policy.normalization import Normalization
from pipeline.policy.observation import PolicyShape
from pipeline.store import FeatureStore
from pipeline.train.feature_source import FeatureSource
from pipeline.train.held_out import held_out_contents, held_out_ranges
from pipeline.train.identity import source_of
from pipeline.train.run import Run
from pipeline.train.split import Split
from pipeline.train.state import TrainerState, read_trainer, write_trainer
from pipeline.train.world import World


@dataclass(frozen=True)
class Checkpoints:
    """Writes the checkpoints of a run: policy, what the front has beside it, trainer state."""

    run: Run
    store: FeatureStore
    params: TrainHeadParams
    split: Split
    front: FeatureSource
    normalization: Normalization
    shape: PolicyShape

    def save_best(self, module: nn.Module, step: int, metrics: Mapping[str, float]) -> None:
        """Put these weights at the run's best. Raises `DiskFull`."""
        save_policy(
            self.run.best,
            self._checkpoint(module, step, metrics),
            beside=lambda folder: self._save_front(folder, module),
        )

    def save_last(
        self, module: nn.Module, metrics: Mapping[str, float], state: TrainerState
    ) -> None:
        """Put these weights, and all that going on takes, at the run's last. Raises `DiskFull`."""

        def beside(folder: Path) -> None:
            self._save_front(folder, module)
            write_trainer(folder, state)

        save_policy(self.run.last, self._checkpoint(module, state.step, metrics), beside=beside)

    def _save_front(self, folder: Path, module: nn.Module) -> None:
        self.front.save(folder, module)
        for path in folder.rglob("*"):
            sync(path)

    def _checkpoint(
        self, module: nn.Module, step: int, metrics: Mapping[str, float]
    ) -> PolicyCheckpoint:
        ranges = held_out_ranges(self.store, self.split.held_out)
        return PolicyCheckpoint(
            params=self.params,
            shape=self.shape,
            normalization=self.normalization,
            source=source_of(self.store),
            held_out_ticks=ranges,
            held_out_content=held_out_contents(self.store, ranges),
            step=step,
            weights=self.front.policy_of(module).state_dict(),
            metrics=metrics,
        )


def read_last(run: Run, world: World) -> tuple[Normalization, PolicyShape, TrainerState]:
    """What a run goes on from, read on rank 0 and sent to the others.

    Raises `CheckpointIncomplete` or `CheckpointMismatch`.
    """
    found: list[TrainerState] = []

    def read() -> tuple[Normalization, PolicyShape, TrainerState]:
        checkpoint = load_policy(run.last)
        found.append(read_trainer(run.last))
        said = replace(found[0], weights={}, average={}, optimizer={})
        return checkpoint.normalization, checkpoint.shape, said

    normalization, shape, state = world.shared(read)
    here = found[0] if found else state
    return (
        normalization,
        shape,
        replace(
            state,
            weights=world.tensors(here.weights),
            average=world.tensors(here.average),
            optimizer=world.tensors(here.optimizer),
        ),
    )
