"""Learning rate, decay groups, averaging, history."""

from itertools import pairwise

import pytest
import torch
from torch import nn

from pipeline.base.config import TrainHeadParams
from pipeline.train.log import History
from pipeline.train.optimizer import (
    WeightAverage,
    make_optimizer,
    optimizer_tensors,
    restore_optimizer,
    schedule,
    trainable,
)


class Toy(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(3, 3)
        self.conv = nn.Conv1d(3, 3, 1)
        self.norm = nn.LayerNorm(3)
        self.embedding = nn.Embedding(4, 3)
        self.query = nn.Parameter(torch.ones(2, 3))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.norm(self.linear(x)).sum()


def test_the_rate_warms_up_peaks_and_ends_at_its_floor():
    params = TrainHeadParams(warmup_steps=10, max_steps=111, min_lr_fraction=0.1)
    rates = [schedule(step, params) for step in range(111)]
    assert rates[:10] == pytest.approx([0.1 * step for step in range(1, 11)])
    assert rates[10] == 1.0
    assert rates[60] == pytest.approx(0.1 + 0.9 / 2)
    assert rates[110] == pytest.approx(0.1)
    assert all(a >= b for a, b in pairwise(rates[10:]))


@pytest.mark.parametrize(("warmup", "steps"), [(0, 1), (5, 5), (100, 3), (1, 2), (3, 40)])
def test_the_rate_is_sane_at_the_extremes(warmup, steps):
    params = TrainHeadParams(warmup_steps=warmup, max_steps=steps, min_lr_fraction=0)
    rates = [schedule(step, params) for step in range(steps)]
    assert min(rates) >= 0
    assert max(rates) == 1.0


def test_every_group_has_its_own_peak_and_decay():
    params = TrainHeadParams(lr=1e-3, weight_decay=0.1)
    toy = Toy()
    toy.embedding.requires_grad_(False)
    optimizer = make_optimizer(toy, params, {"linear.weight": 0.5, "linear.bias": 0.5}.get)
    found = {
        name: (group["peak_lr"], group["weight_decay"])
        for group in optimizer.param_groups
        for name, value in toy.named_parameters()
        if any(value is member for member in group["params"])
    }
    assert found == {
        "linear.weight": (0.5, 0.1),
        "linear.bias": (0.5, 0.0),
        "conv.weight": (1e-3, 0.1),
        "conv.bias": (1e-3, 0.0),
        "norm.weight": (1e-3, 0.0),
        "norm.bias": (1e-3, 0.0),
        "query": (1e-3, 0.0),
    }


def test_the_optimizer_goes_on_where_it_was():
    params = TrainHeadParams(lr=0.1)

    def steps(toy: nn.Module, optimizer: torch.optim.Optimizer, count: int) -> None:
        for _ in range(count):
            optimizer.zero_grad()
            toy(torch.ones(2, 3)).backward()
            optimizer.step()

    torch.manual_seed(0)
    through = Toy()
    optimizer = make_optimizer(through, params, lambda name: None)
    steps(through, optimizer, 3)
    stopped = Toy()
    stopped.load_state_dict(through.state_dict())
    resumed = make_optimizer(stopped, params, lambda name: None)
    restore_optimizer(resumed, stopped, optimizer_tensors(optimizer, through))
    steps(through, optimizer, 4)
    steps(stopped, resumed, 4)
    for name, value in through.state_dict().items():
        assert torch.equal(stopped.state_dict()[name], value), name


def test_the_average_follows_its_formula():
    policy = nn.Linear(1, 1, bias=False)
    nn.init.constant_(policy.weight, 0.0)
    average = WeightAverage(policy, decay=0.5)
    expected = 0.0
    for update in range(1, 30):
        nn.init.constant_(policy.weight, float(update))
        average.update(update)
        decay = min(0.5, update / (update + 9))
        expected = decay * expected + (1 - decay) * update
        assert average.module.weight.item() == pytest.approx(expected, rel=1e-5)
    assert not average.module.training
    assert not average.module.weight.requires_grad


def test_what_does_not_learn_is_shared_and_left_alone():
    toy = Toy()
    toy.linear.requires_grad_(False)
    toy.register_buffer("statistics", torch.ones(3))
    average = WeightAverage(toy, decay=0.5)
    assert average.module.linear.weight is toy.linear.weight
    assert average.module.statistics is toy.statistics
    assert average.module.conv.weight is not toy.conv.weight
    assert set(average.weights) == set(trainable(toy))
    before = toy.linear.weight.clone()
    nn.init.constant_(toy.conv.weight, 3.0)
    average.update(1)
    assert torch.equal(toy.linear.weight, before)
    assert toy.conv.weight.requires_grad
    assert not average.module.conv.weight.requires_grad


def test_history_settles_late_and_names_the_first_bad_step():
    history = History()
    for step in range(5):
        loss = torch.tensor(float("nan") if step >= 3 else float(step))
        history.add({"loss": loss, "grad_norm": torch.tensor(1.0)})
        if step == 1:
            assert history.settle() is None
    assert history.settle() == 3
    assert history.settle() is None
    assert history.tensor().shape == (5, 2)
    assert history.mean(0, 3) == {"loss": 1.0, "grad_norm": 1.0}
    assert history.describe(3) == "loss nan, grad_norm 1"
    again = History(history.columns, history.tensor()[:3])
    assert again.last("loss") == 2.0
