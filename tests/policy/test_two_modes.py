"""What the experts learn of two modes: who samples finds both, who predicts lands between."""

from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from pipeline.policy.expert import ActionExpert
from pipeline.policy.flow_matching import FlowMatchingActionExpert
from pipeline.policy.regression import RegressionActionExpert

EXPERTS: dict[str, tuple[type[ActionExpert], dict[str, Any]]] = {
    "flow": (FlowMatchingActionExpert, {"solver": "rk4"}),
    "regression": (RegressionActionExpert, {}),
}
OPEN, LEFT, RIGHT = range(3)
"""Contexts: either mode, with the mixture's weights; the left one; the right one."""


def contexts(which: Tensor) -> Tensor:
    return 2 * F.one_hot(which, 32).float().unsqueeze(1)


def chunks(mixture: Any, which: Tensor, generator: torch.Generator) -> Tensor:
    free = mixture.draw(len(which), generator)
    noise = mixture.spread * torch.randn(free.shape, generator=generator)
    told = mixture.means[(which == RIGHT).long()].unsqueeze(1) + noise
    return torch.where((which == OPEN).view(-1, 1, 1), free, told)


def train(expert: ActionExpert, mixture: Any, steps: int, batch: int = 256) -> None:
    generator = torch.Generator().manual_seed(1)
    optimizer = torch.optim.Adam(expert.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    valid = torch.ones(batch, 1, dtype=torch.bool)
    for _ in range(steps):
        which = torch.randint(0, 3, (batch,), generator=generator)
        target = chunks(mixture, which, generator)
        loss, _ = expert.loss(contexts(which), target, valid, generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


@cache
def trained(name: str, mixture: Any) -> ActionExpert:
    kind, arguments = EXPERTS[name]
    torch.manual_seed(0)
    expert: Any = kind(horizon=1, action_dim=2, dim=32, layers=1, heads=2, dropout=0.0, **arguments)
    train(expert, mixture, steps=350 if expert.stochastic else 200)
    return expert


def drawn(expert: ActionExpert, which: int, count: int = 2000) -> Tensor:
    context = contexts(torch.full((count,), which))
    with torch.no_grad():
        return expert.act(context, torch.Generator().manual_seed(2))


def test_samples_have_the_modes_weights_and_spreads(two_modes):
    weights, means, spreads, near = two_modes.judge(drawn(trained("flow", two_modes), OPEN))
    torch.testing.assert_close(weights, two_modes.weights, rtol=0, atol=0.07)
    torch.testing.assert_close(means, two_modes.means, rtol=0, atol=0.1)
    assert ((spreads - two_modes.spread).abs() < 0.35 * two_modes.spread).all()
    assert near > 0.94
    for which in (LEFT, RIGHT):  # the context chooses the mode
        mode, samples = two_modes.means[which - 1], drawn(trained("flow", two_modes), which)[:, 0]
        close = (samples - mode).norm(dim=-1) < 4 * two_modes.spread
        assert close.float().mean() > 0.94
        torch.testing.assert_close(samples.mean(0), mode, rtol=0, atol=0.05)
        assert ((samples[close].std(0) - two_modes.spread).abs() < 0.35 * two_modes.spread).all()


def test_regression_lands_between_the_modes(two_modes):
    """At the minimum of the expected smooth-L1, channel by channel, where nobody ever is."""
    samples = two_modes.draw(20_000, torch.Generator().manual_seed(3))[:, 0]
    grid = torch.linspace(-1.5, 1.5, 301)
    best = []
    for channel in samples.unbind(1):
        targets, guesses = torch.broadcast_tensors(channel[:, None], grid)
        risk = F.smooth_l1_loss(guesses, targets, reduction="none").mean(0)
        best.append(grid[risk.argmin()])
    said = drawn(trained("regression", two_modes), OPEN, 1)[0, 0]
    torch.testing.assert_close(said, torch.stack(best), rtol=0, atol=0.1)
    assert ((said - two_modes.means).norm(dim=-1) > 5 * two_modes.spread).all()
    for which in (LEFT, RIGHT):
        told = drawn(trained("regression", two_modes), which, 1)[0, 0]
        torch.testing.assert_close(told, two_modes.means[which - 1], rtol=0, atol=0.05)
