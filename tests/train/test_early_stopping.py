"""A run ends when it has stopped getting better, wherever it is stopped on the way."""

import csv

import pytest

from pipeline.base.errors import ConfigError
from pipeline.policy.checkpoint import load_policy
from pipeline.train.loop import EarlyStopping, Trainer


def test_it_counts_since_the_best():
    stopping = EarlyStopping(patience=2)
    assert [stopping.take(error) for error in (3.0, 2.0, 2.0, 1.0)] == [True, True, False, True]
    assert (stopping.best_error, stopping.stalled, stopping.exhausted) == (1.0, 0, False)
    stopping.take(5.0)
    assert not stopping.exhausted
    stopping.take(1.5)
    assert stopping.exhausted
    assert not EarlyStopping(None, 1.0, stalled=10**6).exhausted


def test_stopping_early_needs_something_held_out(store, params, trainer):
    with pytest.raises(ConfigError, match=r"early_stopping is 3, .*train_head\.split\.val is 0"):
        trainer(store, params(early_stopping=3, split={"val": 0}))


@pytest.mark.parametrize("stopped", [7, None])
def test_it_stops_early_also_when_it_was_interrupted(
    store, params, trainer, monkeypatch, stop_at, capsys, stopped
):
    errors = {2: 0.9, 4: 0.5, 6: 0.8, 8: 0.6, 10: 0.7, 12: 0.1}  # by step
    monkeypatch.setattr(Trainer, "_measure", lambda self, log: {"val/error": errors[self.step]})
    chosen = params(early_stopping=3, eval_every=2, checkpoint_every=1, max_steps=100)
    stop_at(trainer(store, chosen), stopped)
    done = trainer(store, chosen)
    done.fit()
    assert done.step == 10
    assert "stopped early at step 10: 3 evaluations without a better one" in capsys.readouterr().out
    assert load_policy(done.run.output / "best").step == 4
    assert load_policy(done.run.output / "last").step == 10
    with (chosen.logs / "plots/metrics/train/loss.tsv").open() as file:
        assert [row["step"] for row in csv.DictReader(file, delimiter="\t")] == ["10"]
