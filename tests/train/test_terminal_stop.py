"""Beyond the end a robot stands still, and learns to."""

import numpy as np
import pytest
import torch

from pipeline.policy.observation import moving_channels
from pipeline.store import FeatureStore
from pipeline.train.loop import stand_still

LAST = [29, 28, 5]
"""The last tick of the first episode, the one before it, and one in its midst."""


@pytest.mark.parametrize("kind", ["delta", "velocity", "absolute"])
def test_what_is_done_beyond_the_end(store, monkeypatch, kind):
    streams = store.streams | {"action": store.streams["action"] | {"kind": kind}}
    monkeypatch.setattr(FeatureStore, "streams", streams)
    batch = store.gather(LAST, 3, 1, 1)
    before = batch.action.clone()
    moves = torch.tensor(moving_channels(store.streams["action"]))
    action, valid = stand_still(batch.action, batch.action_valid, moves)
    assert valid.all()
    assert torch.equal(batch.action, before), "the store's buffer is left alone"
    recorded = torch.from_numpy(np.array(store.array("tick/action")))
    for row, (tick, real) in enumerate(zip(LAST, (1, 2, 3), strict=True)):
        assert torch.equal(action[row, :real], recorded[tick : tick + real])
        beyond = recorded[29].clone()
        if kind != "absolute":
            beyond[:4] = 0
        assert beyond[4] == 1, "the gripper stays as it is"
        assert torch.equal(action[row, real:], beyond.expand(3 - real, -1))


def test_a_run_learns_to_stop(store, params, trainer):
    """With a chunk longer than an episode most of what is learnt is standing still."""
    chosen = {"horizon": 40, "max_steps": 60, "lr": 1e-2, "eval_every": 60}
    stopping = trainer(store, params(**chosen, terminal_stop=True))
    stopping.fit()
    batch = store.gather([29, 59], 40, 6, 5)
    acted = stopping.averaged.act(batch)[:, 5:]
    assert acted[..., :4].abs().mean() < 0.15, "deltas are about 1 in training"
    assert acted[..., 4].mean() == pytest.approx(1, abs=0.1)
