"""What a front brings is trained, averaged, kept and saved; what it holds frozen is not copied."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from pipeline.base.config import TrainHeadParams
from pipeline.base.files import read_document
from pipeline.policy.checkpoint import load_policy
from pipeline.policy.policy import Policy, Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, FeatureSource, Prefetch, Windows
from pipeline.train.loop import Trainer
from pipeline.train.run import open_run
from pipeline.train.split import split_by_episode


class Adapted(Trainable):
    """A policy whose features pass a large frozen matrix and a small one that learns."""

    def __init__(self, policy: Policy, dim: int) -> None:
        super().__init__()
        self.policy = policy
        self.frozen = nn.Linear(dim, dim).requires_grad_(False)
        self.adapter = nn.Linear(dim, dim, bias=False)

    def seen(self, observation: Any) -> Any:
        features = observation.features + self.adapter(self.frozen(observation.features))
        return type(observation)(**vars(observation) | {"features": features})

    def loss(self, observation: Any, *rest: Any) -> tuple[Tensor, dict[str, Tensor]]:
        return self.policy.loss(self.seen(observation), *rest)

    def sample(self, observation: Any, *rest: Any) -> Tensor:
        return self.policy.sample(self.seen(observation), *rest)

    @property
    def stochastic(self) -> bool:
        return self.policy.stochastic

    def parameter_table(self) -> list[tuple[str, int]]:
        return [("adapter", self.adapter.weight.numel()), *self.policy.parameter_table()]


class AdaptedFront(FeatureSource):
    eval_ticks = 7

    def __init__(self, store: FeatureStore) -> None:
        super().__init__(store)
        self.identity = {"adapter": "square"}
        self.judged: list[int] = []

    def attach(self, policy: Policy) -> Adapted:
        return Adapted(policy, self.store.feature_shape[1])

    def policy_of(self, module: Trainable) -> Policy:
        assert isinstance(module, Adapted)
        return module.policy

    def parameter_lr(self, name: str) -> float | None:
        return 1e-2 if name.startswith("adapter") else None

    def feed(
        self, plan: Iterable[BatchIndices], windows: Windows, device: torch.device
    ) -> Prefetch:
        if isinstance(plan, Iterator):
            return Prefetch(self.store, plan, windows, device)
        plan = list(plan)
        self.judged.append(sum(len(draw.ticks) for draw in plan))
        return Prefetch(self.store, plan, windows, device)

    def save(self, folder: Path, module: Trainable) -> None:
        assert isinstance(module, Adapted)
        (folder / "adapter").mkdir()
        torch.save(module.adapter.state_dict(), folder / "adapter/weights.pt")


def make(store: FeatureStore, params: TrainHeadParams) -> Trainer:
    front = AdaptedFront(store)
    split = split_by_episode(store, params.split, params.horizon)
    return Trainer(store, params, split, open_run(params, store, front.identity), front)


def test_what_a_front_brings_is_trained_judged_and_saved(store, params):
    done = make(store, params(max_steps=8))
    module = done.module
    assert isinstance(module, Adapted)
    begun = {name: value.clone() for name, value in module.state_dict().items()}
    done.fit()
    changed = {name for name, v in module.state_dict().items() if not torch.equal(v, begun[name])}
    assert "adapter.weight" in changed
    assert not {"frozen.weight", "frozen.bias"} & changed
    assert done.averaged.frozen.weight is module.frozen.weight
    assert done.averaged.adapter.weight is not module.adapter.weight
    assert done.source.judged == [7], "its own limit of held-out ticks, in its own feed"

    rates = {
        name: group["lr"]
        for group in done.optimizer.param_groups
        for name, value in module.named_parameters()
        if any(value is member for member in group["params"])
    }
    base = rates["policy.expert.head.bias"]
    assert rates["adapter.weight"] == pytest.approx(base * 1e-2 / 3e-3)
    assert not any(name.startswith("frozen") for name in rates)

    for name in ("best", "last"):
        saved = torch.load(done.run.output / name / "adapter/weights.pt")
        assert torch.equal(saved["weight"], done.averaged.adapter.weight)
        assert set(load_policy(done.run.output / name).weights) == set(
            done.averaged.policy.state_dict()
        )
    decides = read_document(done.run.output / "run.json", dict)[1]["decides"]
    assert decides["front"] == {"adapter": "square"}
    assert any("learns" in line and "of" in line for line in done.summary())


def test_a_run_with_a_front_goes_on_to_the_bit(store, params, tmp_path, stop_at):
    steps = {"max_steps": 8, "checkpoint_every": 5}
    whole = make(store, params(**steps, output=tmp_path / "whole", logs=tmp_path / "whole_logs"))
    whole.fit()
    stop_at(make(store, params(**steps)), 6)
    resumed = make(store, params(**steps))
    assert resumed.step == 5
    resumed.fit()
    for a, b in ((resumed.module, whole.module), (resumed.averaged, whole.averaged)):
        for name, value in a.state_dict().items():
            assert torch.equal(value, b.state_dict()[name]), name
