"""Chunks that continue others: with the best possible network, against closed forms."""

import pytest
import torch
from torch import Tensor

from pipeline.policy.diffusion import DiffusionActionExpert
from pipeline.policy.expert import ActionExpert, Guide
from pipeline.policy.flow_matching import FlowMatchingActionExpert
from tests.policy.optimal import optimal

HORIZON, KEPT, COUNT = 12, 5, 2000
STEP = torch.arange(HORIZON, dtype=torch.float64)
COVARIANCE = 0.8 ** (STEP[:, None] - STEP[None]).abs()
"""Of chunks (horizon, 1) whose steps follow each other, of unit variance."""


class Process:
    """A Gaussian one of this covariance; all rows of a batch are at the same time."""

    size = (HORIZON, 1)

    def expectations(self, noisy: Tensor, signal: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """What is left of sample and noise on average, given signal * sample + noise * epsilon."""
        signal, noise = signal[0].double(), noise[0].double()
        total = signal**2 * COVARIANCE + noise**2 * torch.eye(HORIZON, dtype=torch.float64)
        white = torch.linalg.solve(total, noisy)
        return signal * COVARIANCE @ white, noise * white


VARIANTS = [
    (FlowMatchingActionExpert, {"solver": "rk4"}),
    (DiffusionActionExpert, {"prediction": "v", "clip": None}),
    (DiffusionActionExpert, {"sampler": "ddpm", "timesteps": 50}),
]


@pytest.fixture(params=VARIANTS, ids=lambda v: f"{v[0].__name__}-{v[1]}")
def expert(request):
    kind, arguments = request.param
    return optimal(kind, Process(), **arguments)


def drawn(expert: ActionExpert, guide: Guide | None = None, count: int = COUNT) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return expert.act(torch.zeros(count, 1, 8), generator, guide).squeeze(-1).double()


def prefix_guide(prefix: Tensor, count: int = COUNT) -> Guide:
    """Weight 1 on the steps of a prefix, zeros without weight behind it."""
    chunk, weight = torch.zeros(count, HORIZON, 1), torch.zeros(count, HORIZON)
    chunk[:, : len(prefix), 0], weight[:, : len(prefix)] = prefix.float(), 1.0
    return Guide(chunk, weight)


class TestPrefix:
    PREFIX = torch.tensor([1.4, 1.0, 1.7, 1.2, 1.5], dtype=torch.float64)

    def test_the_chunk_begins_with_it(self, expert):
        guided, free = drawn(expert, prefix_guide(self.PREFIX)), drawn(expert)
        error, before = ((x[:, :KEPT] - self.PREFIX).square().mean().sqrt() for x in (guided, free))
        assert error < 0.13
        assert before > 1.5

    def test_the_rest_follows_from_it_and_stays_free(self, expert):
        """Near the mean and spread of a Gaussian of which the first steps are known."""
        rest = drawn(expert, prefix_guide(self.PREFIX))[:, KEPT:]
        known = COVARIANCE[:KEPT, :KEPT]
        share = torch.linalg.solve(known, COVARIANCE[:KEPT, KEPT:]).T
        spread = (COVARIANCE[KEPT:, KEPT:] - share @ COVARIANCE[:KEPT, KEPT:]).diagonal().sqrt()
        torch.testing.assert_close(rest.mean(0), share @ self.PREFIX, rtol=0, atol=0.2)
        ratio = rest.std(0) / spread
        assert (ratio > 0.7).all()
        assert (ratio < 1.1).all()

    def test_less_weight_pulls_less(self, expert):
        whole = prefix_guide(self.PREFIX)
        errors = []
        for weight in (0.0, 0.1, 0.4, 1.0):
            chunk = drawn(expert, Guide(whole.chunk, weight * whole.weight))
            errors.append(float((chunk[:, :KEPT] - self.PREFIX).square().mean()))
        assert errors[0] > errors[1] > errors[2] > errors[3]

    def test_what_has_no_weight_is_not_looked_at(self, expert):
        """As zeros behind the end of a plan, which are the mean action."""
        guide = prefix_guide(self.PREFIX, 50)
        other = guide.chunk.clone()
        other[:, KEPT:] = 1000.0
        expected = drawn(expert, guide, 50)
        assert torch.equal(drawn(expert, Guide(other, guide.weight), 50), expected)


def test_what_the_clip_holds_is_still_pulled():
    """An epsilon is divided by what is left of the chunk: an unsure network's are all clipped."""
    torch.manual_seed(0)
    expert = DiffusionActionExpert(dim=32, layers=2, heads=2, prediction="epsilon").eval()
    context, guide = torch.randn(16, 3, 32), Guide(torch.randn(16, 8, 7), torch.ones(16, 8))
    free, guided = (expert.act(context, torch.Generator(), given) for given in (None, guide))
    assert free.abs().median() == 5.0
    assert (guided - guide.chunk).square().mean() < 1e-2
