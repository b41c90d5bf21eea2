"""Every step is cut into parts that together are the whole, whoever computes them."""

from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.store import FeatureStore
from pipeline.train.loop import Trainer
from pipeline.train.sampling import Plan
from pipeline.train.split import split_by_episode


@pytest.fixture
def plan(store, params):
    """`plan(key=value, ...)`: the plan of small params."""

    def make(**changed: Any) -> Plan:
        made = params(**changed)
        return Plan(store, made, split_by_episode(store, made.split, made.horizon))

    return make


@pytest.mark.parametrize("parts", [3, 8])
def test_parts_are_the_whole(store, plan, parts):
    whole, cut = plan(), plan(grad_accumulation=parts)
    for step in range(30):
        found = cut.step(step)
        assert len(found) == parts
        assert np.concatenate([part.ticks for part in found]).tolist() == whole.ticks(step).tolist()
        assert sum(part.share for part in found) == pytest.approx(1)
        valid = store.gather(whole.ticks(step), 3, 1, 1).action_valid.sum()
        for part in found:
            here = store.gather(part.ticks, 3, 1, 1).action_valid.sum()
            assert part.share == pytest.approx(float(here / valid))


def test_seeds_differ_by_step_and_part(plan):
    cut = plan(grad_accumulation=4)
    seeds = [part.seed for step in range(20) for part in cut.step(step)]
    assert len(set(seeds)) == 80
    assert {part.seed for part in plan(grad_accumulation=4, seed=1).step(0)}.isdisjoint(seeds)


def test_fewer_ticks_than_parts_are_refused(store, params, plan):
    made = params(batch_size=7, grad_accumulation=8)
    split = split_by_episode(store, made.split, made.horizon)
    with pytest.raises(ConfigError, match=r"^finetune\.batch_size is 7.* of the 8 parts"):
        Plan(store, made, split, "finetune")


def test_variants_are_drawn_from_seed_and_step(store, plan, monkeypatch):
    assert plan().step(0)[0].variants is None
    monkeypatch.setattr(FeatureStore, "variants", 3)
    whole = [part.variants for step in range(40) for part in plan().step(step)]
    cut = [part.variants for step in range(40) for part in plan(grad_accumulation=2).step(step)]
    assert np.concatenate(whole).tolist() == np.concatenate(cut).tolist()
    assert np.bincount(np.concatenate(whole)).min() > 320 / 3 * 0.7
    assert any(a.tolist() != whole[0].tolist() for a in whole[1:])
    other = plan(seed=1).step(0)[0].variants
    assert other.tolist() != whole[0].tolist()


def test_accumulated_gradients_are_those_of_the_whole_batch(store, params, trainer, tmp_path):
    """Without dropout; ticks near an episode's end give the parts unequal weight."""
    still = {"expert": {"dim": 16, "layers": 1, "heads": 2, "dropout": 0.0}, "horizon": 12}
    runs: list[Trainer] = []
    for parts in (1, 3):
        output = tmp_path / f"by_{parts}"
        runs.append(
            trainer(store, params(**still, max_steps=5, grad_accumulation=parts, output=output))
        )
        runs[-1].fit()
    whole, cut = (run.history.tensor() for run in runs)
    assert torch.allclose(whole, cut, rtol=1e-4)
    for a, b in zip(runs[0].policy.parameters(), runs[1].policy.parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-4)
