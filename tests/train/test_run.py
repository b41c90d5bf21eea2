"""What a start finds at its output decides what it does, and nothing of another's is lost."""

import os
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch, ConfigError
from pipeline.base.files import read_document
from pipeline.store import FeatureStore
from pipeline.train.run import RUN_FOLDER, TRAINER_VERSION, finished_run, open_run


@pytest.fixture(scope="session")
def params_below(params_below):
    """Of few steps: what is asked here is not how well it learns."""
    return partial(params_below, max_steps=6, warmup_steps=2, eval_every=3, checkpoint_every=2)


@pytest.fixture(scope="module")
def runs(store, params_below, trainer, tmp_path_factory):
    """`head`, which is finished, and `stopped.part`, stopped at step 5; both to be copied."""
    folder = tmp_path_factory.mktemp("runs")
    trainer(store, params_below(folder)).fit()
    stopped = trainer(store, params_below(folder, output=folder / "stopped"))
    step = stopped._train_step

    def killed(*rest: Any) -> None:
        if stopped.step == 5:
            raise InterruptedError
        step(*rest)

    stopped._train_step = killed
    with pytest.raises(InterruptedError):
        stopped.fit()
    return folder


@pytest.fixture
def finished(runs, params):
    """The output of a run that has come to its end."""
    return shutil.copytree(runs / "head", params().output)


@pytest.fixture
def unfinished(runs, params):
    """The folder of a run stopped at step 5, its last checkpoint at step 4."""
    return shutil.copytree(runs / "stopped.part", params().output.with_name("head.part"))


def decided(folder: Path) -> dict[str, Any]:
    """The params of a run, as its folder says."""
    return read_document(folder / "run.json", dict)[1]["decides"]["train_head"]


def test_a_finished_run_is_left_alone(store, params, finished):
    leftover = finished / "last" / "trainer.json"
    leftover.touch()  # killed between renaming and tidying
    assert len(open_run(params(), store).notes) == 1
    run = open_run(params(logs="elsewhere", checkpoint_every=1, loggers=["wandb"]), store)
    assert run.status == "finished"
    assert open_run(params(), store, {"adapter": "another"}).status == "new"
    assert open_run(params(grad_accumulation=2), store).status == "new"
    assert not leftover.exists()


def test_a_finished_run_is_trained_anew_where_that_is_asked_for(store, params, finished):
    """As `dvc repro` asks, where code changed that the run cannot see."""
    anew = params(anew=True)
    assert finished_run(anew, store.path) is None
    run = open_run(anew, store)
    assert run.status == "new" and "holds this very run; it is replaced" in run.notes[0]
    assert finished_run(params(), store.path) is not None


def test_another_run_replaces_a_finished_one_when_it_is_finished(store, params, trainer, finished):
    other = trainer(store, params(seed=5))
    assert other.run.status == "new"
    assert "holds another run" in other.run.notes[0]
    assert decided(finished)["seed"] == 0
    other.fit()
    assert decided(finished)["seed"] == 5
    assert sorted(p.name for p in params().output.parent.glob("head*")) == ["head"]


def test_other_params_move_an_unfinished_run_aside(store, params, unfinished):
    aside = unfinished.with_name("head.part-old")
    run = open_run(params(lr=0.5, expert={"dim": 16, "heads": 4}), store)
    assert run.status == "new"
    assert not aside.exists()
    run.begin()
    assert "train_head.lr: 0.003 -> 0.5" in run.notes[0]
    assert "train_head.expert.heads: 2 -> 4" in run.notes[0]
    assert (aside / "last" / "policy.json").exists()
    assert os.listdir(unfinished) == ["run.json"]
    # One that has only begun does not replace what was put aside before.
    run = open_run(params(lr=0.25), store)
    assert run.notes == ()
    run.begin()
    assert decided(unfinished)["lr"] == 0.25
    assert decided(aside)["lr"] == 0.003


def test_nothing_is_written_before_the_params_are_known_to_be_good(
    store, params, trainer, unfinished
):
    before = sorted(unfinished.rglob("*"))
    with pytest.raises(ConfigError):
        trainer(store, params(mixture={"middle": 1.0}))
    assert sorted(unfinished.rglob("*")) == before
    assert not unfinished.with_name("head.part-old").exists()


def test_other_features_or_streams_are_refused(store, params, unfinished, tiny_store, tmp_path):
    other = FeatureStore.open(
        tiny_store(tmp_path, name="other", spec_digest="another", state_dim=0, reuse=5)
    )
    with pytest.raises(CheckpointMismatch) as caught:
        open_run(params(), other)
    said = str(caught.value)
    assert 'feature_spec.digest: "tiny-spec" -> "another"' in said
    assert "streams.state.names" in said
    assert "vlm_reuse_count: 3 -> 5" in said
    assert f"Remove {unfinished}" in said
    assert (unfinished / "last").exists()


def test_other_recordings_of_the_same_kind_begin_anew(
    store, params, unfinished, tiny_store, tmp_path
):
    more = FeatureStore.open(tiny_store(tmp_path, name="more", episodes=7))
    run = open_run(params(), more)
    assert run.status == "new"
    assert "recordings.episodes: 6 -> 7" in run.notes[0]


def test_a_checkpoint_swap_that_was_killed_is_recovered(store, params, trainer, unfinished):
    (unfinished / "last.new").mkdir()
    assert trainer(store, params()).step == 4


@pytest.mark.parametrize(
    ("file", "entry", "altered"),
    [
        ("last/trainer.json", '"step": 4', '"step": 2'),
        ("run.json", '"lr": 0.003', '"lr": 0.03'),
    ],
)
def test_an_altered_document_of_a_run_is_named_and_the_advice_leads_out(
    store, params, trainer, unfinished, file, entry, altered
):
    path = unfinished / file
    assert entry in path.read_text()
    path.write_text(path.read_text().replace(entry, altered, 1))
    advice = "or remove its folder and run the training"
    with pytest.raises(CheckpointIncomplete, match=rf"{path}: it was altered.*{advice}"):
        trainer(store, params())
    shutil.rmtree(path.parent)
    assert trainer(store, params()).run.status == "new"


def test_what_no_training_wrote_is_never_replaced(store, params):
    output = params().output
    output.mkdir()
    assert open_run(params(), store).status == "new"
    (output / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="a training run that this project wrote"):
        open_run(params(), store)
    assert (output / "thesis.tex").exists()


def test_a_run_json_of_another_program_makes_no_training_run(store, params):
    output = params().output
    (output / "models").mkdir(parents=True)
    (output / "models" / "policy.json").write_text("{}")
    (output / "run.json").write_text('{"sweep": 3}')
    with pytest.raises(ConfigError, match="a training run that this project wrote"):
        open_run(params(), store)
    (output / "models").rename(output / "best")
    (output / "run.json").write_text("{")
    assert RUN_FOLDER.owns(output), "a run of ours whose run.json was damaged"


def test_checkpoints_without_their_run_are_not_guessed_at(store, params, unfinished):
    (unfinished / "run.json").unlink()
    with pytest.raises(ConfigError, match="a training run that this project wrote"):
        open_run(params(), store)


def test_a_damaged_finished_run_is_trained_again(store, params, trainer, finished):
    path = finished / "last/policy.json"
    path.write_bytes(path.read_bytes()[:-20])
    assert open_run(params(), store).status == "new"
    shutil.rmtree(finished / "best")
    again = trainer(store, params())
    assert again.run.status == "new"
    assert "this very run, but damaged; it is trained again" in again.run.notes[0]
    again.fit()
    assert open_run(params(), store).status == "finished"


def test_code_of_other_numbers_goes_on_with_no_run(store, params, unfinished, monkeypatch):
    monkeypatch.setattr("pipeline.train.run.TRAINER_VERSION", 99)
    run = open_run(params(), store)
    assert run.status == "new"
    assert f"trainer_version: {TRAINER_VERSION} -> 99" in run.notes[0]
