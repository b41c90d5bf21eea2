"""A run that is stopped anywhere ends where an undisturbed one ends, to the bit."""

import csv
import json
import os
import re
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.errors import NumericsError, StoreIncomplete
from pipeline.base.files import read_document
from pipeline.policy.checkpoint import load_policy
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.loop import Trainer, read_trainer
from pipeline.train.predictions import predict
from pipeline.train.run import TRAINER_VERSION
from pipeline.train.scores import action_space, compare
from tests.store.samples import content

GOLDEN = Path(__file__).with_name("golden_run.json")


def losses(trainer: Trainer) -> list[float]:
    column = trainer.history.columns.index("loss")
    return trainer.history.tensor()[:, column].tolist()


@pytest.fixture(scope="module")
def undisturbed(store, params_below, trainer, tmp_path_factory):
    """Twenty steps, finished; nothing of it is changed by a test."""
    done = trainer(store, params_below(tmp_path_factory.mktemp("whole")))
    done.fit()
    return done


@pytest.mark.parametrize("stopped", [pytest.param(1, marks=pytest.mark.slow), 13, None])
def test_killed_at_any_step_it_ends_the_same(store, params, trainer, undisturbed, stop_at, stopped):
    stop_at(trainer(store, params()), stopped)
    # What decides no number may change between the two starts.
    resumed = trainer(store, params(checkpoint_every=7))
    assert resumed.run.status == ("new" if stopped == 1 else "resumed")
    assert resumed.step == {1: 0, 13: 10, None: 20}[stopped]
    resumed.fit()
    assert losses(resumed) == losses(undisturbed)
    for which in ("policy", "averaged"):
        weights = getattr(undisturbed, which).state_dict()
        for name, value in getattr(resumed, which).state_dict().items():
            assert torch.equal(value, weights[name]), name
    assert resumed.stopping.best_error == undisturbed.stopping.best_error
    logs, whole = resumed.params.logs, undisturbed.params.logs
    assert content(logs) == content(whole)


def test_a_signal_ends_the_step_and_saves_once(store, params, trainer, monkeypatch):
    real, save = Trainer._train_step, Trainer._save_last
    saved: list[int] = []

    def signalled(self: Trainer, *rest: Any) -> None:
        if self.step == 12:
            os.kill(os.getpid(), signal.SIGTERM)
        real(self, *rest)

    def counted(self: Trainer, *rest: Any) -> None:
        saved.append(self.step)
        save(self, *rest)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "_train_step", signalled)
        patched.setattr(Trainer, "_save_last", counted)
        with pytest.raises(KeyboardInterrupt):
            trainer(store, params(checkpoint_every=13)).fit()
    assert saved == [13], "also where a checkpoint is due"
    assert trainer(store, params()).step == 13


def test_what_a_finished_run_leaves(undisturbed):
    output, logs = undisturbed.run.output, undisturbed.params.logs
    assert sorted(os.listdir(output)) == ["best", "last", "run.json"]
    assert sorted(os.listdir(output / "last")) == ["policy.json", "policy.safetensors"]
    assert not undisturbed.run.part.exists()
    last, best = load_policy(output / "last"), load_policy(output / "best")
    assert last.step == 20
    assert best.metrics["val/error"] == undisturbed.stopping.best_error
    for name, value in undisturbed.averaged.state_dict().items():
        assert torch.equal(last.weights[name], value)
    with (logs / "plots/metrics/val/error.tsv").open() as file:
        curve = {
            int(row["step"]): float(row["error"]) for row in csv.DictReader(file, delimiter="\t")
        }
    assert set(curve) == {8, 16, 20}
    assert min(curve.values()) == undisturbed.stopping.best_error
    assert curve[best.step] == undisturbed.stopping.best_error
    with (logs / "plots/metrics/train/loss.tsv").open() as file:
        rows = [float(row["loss"]) for row in csv.DictReader(file, delimiter="\t")]
    assert rows == pytest.approx(
        [np.mean(losses(undisturbed)[:10]), np.mean(losses(undisturbed)[10:])]
    )
    metrics = read_document(logs / "metrics.json", dict)[1]
    assert {"loss", "grad_norm", "translation", "rotation", "gripper"} == set(metrics["train"])
    assert {"error", "translation_mm", "rotation_deg", "gripper"} == set(metrics["val"])


def test_checkpoints_are_kept_through_a_kill(store, params, trainer, stop_at):
    stop_at(trainer(store, params(keep_every=4)), 13)
    resumed = trainer(store, params(keep_every=4))
    assert resumed.step == 10
    resumed.fit()
    kept = {int(step.name): load_policy(step) for step in (resumed.run.output / "steps").iterdir()}
    assert {step: policy.step for step, policy in kept.items()} == {
        at: at for at in range(4, 21, 4)
    }
    last = load_policy(resumed.run.output / "last").weights
    assert all(torch.equal(value, last[name]) for name, value in kept[20].weights.items())
    assert any(not torch.equal(value, last[name]) for name, value in kept[12].weights.items())


def test_without_held_out_episodes_the_best_is_the_newest(store, params, trainer):
    done = trainer(store, params(split={"val": 0, "test": 0}, max_steps=4, eval_every=2))
    done.fit()
    best = load_policy(done.run.output / "best")
    assert best.step == 4
    assert not best.split["val"]
    assert not best.split["test"]


def test_nothing_in_training_looks_at_test(tiny_store, params, trainer, tmp_path):
    """Other features, actions and readings in the test episodes change no bit of what is kept."""
    kept: list[dict[str, Any]] = []
    for name in ("plain", "spoilt"):
        store = FeatureStore.open(tiny_store(tmp_path / name))
        given = {"split": {"val": 0.3, "test": 0.3}, "early_stopping": 2}
        folders = {"output": tmp_path / name / "head", "logs": tmp_path / name / "logs"}
        done = trainer(store, params(max_steps=12, eval_every=4, **given, **folders))
        for episode in {store.episodes[i] for i in store.episode_of(done.split.test)}:
            for array, rows in (
                ("tick/action", episode.ticks),
                ("vl/features", episode.vl_rows),
                ("sensor/values", episode.readings),
                ("state/values", episode.states),
            ):
                if name == "spoilt":
                    store.array(array)[rows.start : rows.stop] += 1e6
        assert len(done.split.val)
        assert len(done.split.test)
        done.fit()
        kept.append({which: load_policy(done.run.output / which) for which in ("best", "last")})
    for which, plain in kept[0].items():
        spoilt = kept[1][which]
        assert (spoilt.step, spoilt.metrics) == (plain.step, plain.metrics)
        assert spoilt.normalization.document() == plain.normalization.document()
        assert all(torch.equal(spoilt.weights[name], plain.weights[name]) for name in plain.weights)


def test_any_stream_may_be_left_out(store, params, trainer, stop_at):
    for disabled in ("features_enabled", "sensor_enabled", "robot_state_enabled"):
        begun = trainer(store, params(**{disabled: False}))
        assert any(f"disabled by train_head.{disabled}" in line for line in begun.summary())
        stop_at(begun, 1)
        assert begun.history.settle() is None


def test_a_loss_that_is_not_finite_names_step_and_ticks(store, params, trainer, monkeypatch):
    stopped = trainer(store, params())
    real = stopped.policy.loss

    def diverging(*arguments: Any) -> Any:
        loss, parts = real(*arguments)
        return (loss * float("inf") if stopped.step == 7 else loss), parts

    monkeypatch.setattr(stopped.policy, "loss", diverging)
    with pytest.raises(NumericsError, match="step 8: expected a finite loss") as caught:
        stopped.fit()
    assert str(stopped.plan.ticks(7).tolist()) in str(caught.value)
    # The checkpoint on disk is the one from before.
    assert read_trainer(stopped.run.last)[0].step == 5


def test_the_golden_run(undisturbed):
    """Twenty steps with the losses they have always had.

    A refactor changes no bit on a kind of machine that is in the file; elsewhere float32 sums are
    taken in another order, also with the same instructions on a processor of another make. After a
    change of numerics that is meant, raise `TRAINER_VERSION`, delete the file, run this test, and
    say so in the commit; to add a kind of machine, run it there before.
    """
    assert torch.get_num_threads() == 1
    vendor = re.search(r"vendor_id\s*: (\S+)", Path("/proc/cpuinfo").read_text())
    parts = (torch.__version__, torch.backends.cpu.get_cpu_capability(), vendor and vendor[1])
    machine = " ".join(map(str, parts))
    found = losses(undisturbed)
    if not GOLDEN.exists():
        document = {"trainer": TRAINER_VERSION, "losses": {machine: found}}
        GOLDEN.write_text(json.dumps(document, indent=1) + "\n")
        pytest.fail(f"{GOLDEN.name} was missing and has been written: run the test again")
    golden = json.loads(GOLDEN.read_text())
    assert golden["trainer"] == TRAINER_VERSION, f"delete {GOLDEN.name} and run the test again"
    changed = "other numbers: if that is meant, raise TRAINER_VERSION in pipeline/train/run.py"
    assert found == golden["losses"].get(machine, found), changed
    for kept in golden["losses"].values():
        assert found == pytest.approx(kept, rel=1e-4), changed


def test_autocast_trains_in_bfloat16(store, params, trainer, undisturbed, stop_at):
    rough = trainer(store, params(amp="bfloat16"))
    assert any("bfloat16 autocast" in line for line in rough.summary())
    stop_at(rough, 4)
    assert rough.history.settle() is None
    assert losses(rough) == pytest.approx(losses(undisturbed)[:4], rel=0.05)
    assert losses(rough) != losses(undisturbed)[:4]
    assert all(value.dtype == torch.float32 for value in rough.policy.state_dict().values())


def test_logs_never_write_through_a_link(store, params, trainer, tmp_path):
    """As DVC restores an output: every file a link into its cache."""
    short = {"max_steps": 3, "eval_every": 2}
    trainer(store, params(**short)).fit()
    logs, cache = params().logs, tmp_path / "cache"
    kept = {}
    for file in logs.rglob("*.*"):
        if file.is_file():
            linked = cache / str(len(kept))
            cache.mkdir(exist_ok=True)
            linked.hardlink_to(file)
            kept[linked] = linked.read_bytes()
    trainer(store, params(seed=3, **short)).fit()
    assert len(kept) > 5
    assert {file: file.read_bytes() for file in kept} == kept


@pytest.mark.gpu
def test_on_a_gpu_a_run_is_stopped_resumed_and_judged(store, params, trainer, stop_at):
    stop_at(trainer(store, params(device="cuda")), 12)
    resumed = trainer(store, params(device="cuda"))
    assert (resumed.run.status, resumed.step, resumed.device.type) == ("resumed", 10, "cuda")
    resumed.fit()
    assert np.isfinite(losses(resumed)).all()
    best = load_policy(resumed.run.output / "best")
    windows = Windows.of(resumed.params)
    predictions = predict(best.policy("cuda"), store, resumed.split.val, windows, 8)
    comparison = compare(predictions, {}, action_space(store, best.normalization))
    assert comparison.overall("policy") == pytest.approx(best.metrics["val/error"], rel=1e-3)


def test_both_checkpoints_carry_the_golden_rows(tiny_golden, params, trainer, tmp_path):
    store = FeatureStore.open(tiny_golden(tmp_path))
    done = trainer(store, params(max_steps=5))
    done.fit()
    for name in ("best", "last"):
        carried = load_policy(done.run.output / name).golden
        assert [row.key for row in carried] == [row.key for row in store.golden]
        assert np.array_equal(carried[1].features, store.golden[1].features)


def test_a_damaged_golden_row_stops_a_training_before_it_begins(
    tiny_golden, params, trainer, tmp_path
):
    store = FeatureStore.open(tiny_golden(tmp_path))
    frame = store.path / "golden/1/View1/c/0/0/0"
    frame.unlink()
    with pytest.raises(StoreIncomplete, match=rf"{frame}: no such file\. .*verify --repair"):
        trainer(store, params(max_steps=5))
