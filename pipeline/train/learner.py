"""What learns: the module in training, its optimizer, its average, and one step of all three."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from pipeline.base.config import TrainHeadParams
from pipeline.base.device import use_bfloat16
from pipeline.policy.policy import Policy
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices
from pipeline.train.compilation import compiled
from pipeline.train.ema import WeightAverage, trainable
from pipeline.train.feature_source import FeatureSource
from pipeline.train.gradients import sum_gradients
from pipeline.train.optimizer import (
    make_optimizer,
    optimizer_tensors,
    peak_rates,
    restore_optimizer,
    schedule,
    set_learning_rates,
)
from pipeline.train.plan import Part
from pipeline.train.state import TrainerState, load_weights
from pipeline.train.terminal import TerminalStop
from pipeline.train.world import World


class Learner:
    """A policy with its front, trained by AdamW, and the moving average of what learns.

    All processes of `world` begin with the weights of rank 0 and stay equal.
    """

    def __init__(
        self,
        front: FeatureSource,
        policy: Policy,
        store: FeatureStore,
        params: TrainHeadParams,
        device: torch.device,
        world: World,
    ) -> None:
        self._params, self._device, self._world = params, device, world
        self.bfloat16 = use_bfloat16(params.amp, device)
        self.trained = front.attach(policy)
        assert isinstance(self.trained, nn.Module)
        self.module: nn.Module = self.trained.to(device).train()
        self.learning = trainable(self.module)
        """The parameters that learn, by name; the others are neither averaged nor kept."""
        world.spread(value.data for value in self.learning.values())
        self.optimizer = make_optimizer(self.module, params, peak_rates(self.module, front, params))
        self.average = WeightAverage(self.module, params.ema_decay)
        self._terminal = TerminalStop(store, device) if params.terminal_stop else None
        self._compiled = compiled(self.trained.loss, device) if params.compile else None

    def step(
        self,
        number: int,
        parts: Iterable[tuple[BatchIndices, Batch]],
        interrupted: Callable[[], bool],
    ) -> tuple[dict[str, Tensor], bool]:
        """Step `number`, counted from 0, on this process's parts of its batch.

        Returns the loss, the norm of the gradient and the loss's parts, detached and over all
        processes, and whether any process was interrupted.
        """
        set_learning_rates(self.optimizer, schedule(number, self._params))
        self.optimizer.zero_grad(set_to_none=True)
        scalars: dict[str, Tensor] = {}
        for part, batch in parts:
            for name, value in self._backward(part, batch).items():
                scalars[name] = scalars[name] + value if name in scalars else value
        stopped = sum_gradients(self._world, self.learning.values(), scalars, interrupted())
        norm = torch.nn.utils.clip_grad_norm_(self.learning.values(), self._params.grad_clip)
        self.optimizer.step()
        self.average.update(number + 1)
        return {"loss": scalars.pop("loss"), "grad_norm": norm, **scalars}, stopped

    def tensors(self) -> dict[str, Mapping[str, Tensor]]:
        """What going on takes of it: `weights`, `average` and `optimizer` of a `TrainerState`."""
        return {
            "weights": dict(self.learning),
            "average": self.average.weights,
            "optimizer": optimizer_tensors(self.optimizer, self.module),
        }

    def restore(self, state: TrainerState, place: Path) -> None:
        """Go on from there. Raises `CheckpointMismatch` where something else learnt."""
        load_weights(self.learning, state.weights, place)
        load_weights(self.average.weights, state.average, place)
        restore_optimizer(self.optimizer, self.module, state.optimizer)

    def _backward(self, part: BatchIndices, batch: Batch) -> dict[str, Tensor]:
        """Add a part's gradients; its loss and the parts of it, each by its share of the whole."""
        assert isinstance(part, Part), "a feed hands back the draws of its plan"
        # Dropout and sampled noise of a part depend on nothing that came before it.
        torch.manual_seed(part.seed)
        action, valid = batch.action, batch.action_valid
        if self._terminal is not None:
            action, valid = self._terminal.extend(action, valid)
        loss_of = self._compiled or self.trained.loss
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self.bfloat16):
            loss, parts = loss_of(batch, action, valid)
        loss = loss * part.share
        loss.backward()
        return {"loss": loss.detach()} | {name: part.share * v for name, v in parts.items()}
