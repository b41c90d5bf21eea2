"""The one training loop with a model that learns in front."""

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file
from torch import nn

from pipeline.base.config import Params, load_params
from pipeline.base.digests import file_digest
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.base.provenance import read_tuned_on, tuned_on_of_store
from pipeline.extract import extract
from pipeline.policy.checkpoint import find_policy, load_policy
from pipeline.policy.encoders import FeaturePooler
from pipeline.policy.live_policy import LivePolicy
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, Windows
from pipeline.train.finetuning import (
    ModelFeatureSource,
    head_params,
    next_steps,
    out_of_memory_named,
)
from pipeline.train.loop import Trainer
from pipeline.train.predictions import predict
from pipeline.train.run import open_run
from pipeline.train.scores import action_space, compare
from pipeline.train.split import split_by_episode
from pipeline.train.training_data import check_store, find_ticks, refuse_tuned_episodes
from pipeline.vlm.feature_spec import feature_spec

CPU = torch.device("cpu")


def trainer(params: Params) -> Trainer:
    """A trainer that begins anew or goes on with what lies at `finetune.output`."""
    store = FeatureStore.open(params.extract.store)
    head = head_params(params)
    front = ModelFeatureSource(store, params, CPU)
    run = open_run(head, store, front.identity)
    return Trainer(store, head, split_by_episode(store, head.split, 2), run, front)


def learned(output: Path, which: str = "last") -> dict[str, torch.Tensor]:
    adapter = load_file(output / which / "adapter" / "adapter_model.safetensors")
    return adapter | load_file(output / which / "policy.safetensors")


def weights(module: nn.Module) -> dict[str, torch.Tensor]:
    return {n: p.detach().clone() for n, p in module.named_parameters() if p.requires_grad}


def moves(parameter: nn.Parameter) -> bool:
    return parameter.grad is not None and bool(parameter.grad.abs().max() > 0)


def extracted_with(given: Params, place: Path, **vlm: str) -> FeatureStore:
    """The store of the same recordings with another model."""
    document = given.model_dump(mode="json")
    document["vlm"] |= vlm
    document["extract"]["store"] = str(place)
    extract(Params.model_validate(document), say=lambda _: None)
    return FeatureStore.open(place)


def assert_judged_as_in_training(output: Path, store: FeatureStore) -> None:
    """The best policy takes the store, and its error on val is the one that chose it."""
    best = load_policy(find_policy(output))
    check_store(best, store)
    ticks, _ = find_ticks(store, best, "val")
    predictions = predict(best.policy(), store, ticks, Windows.of(best.params), 64)
    comparison = compare(predictions, {}, action_space(store, best.normalization))
    assert comparison.overall("policy") == pytest.approx(best.metrics["val/error"], rel=1e-3)


def test_all_that_learns_does_at_its_own_rate_and_the_loss_falls(params, monkeypatch):
    still = {"dim": 16, "layers": 1, "heads": 2, "dropout": 0.0}
    given = params(
        train_head={"expert": still, "min_lr_fraction": 1.0},
        finetune={
            "batch_size": 8,
            "max_steps": 24,
            "eval_every": 24,
            "eval_ticks": 3,
            "checkpoint_every": 24,
        },
    )
    made = trainer(given)
    plans, feed = list[Any](), made.source.feed
    monkeypatch.setattr(
        made.source, "feed", lambda plan, *of: (plans.append(plan), feed(plan, *of))[1]
    )
    names = {id(p): n for n, p in made.module.named_parameters()}
    for group in made.optimizer.param_groups:
        for parameter in group["params"]:
            of_model = names[id(parameter)].startswith("vlm.")
            section = given.finetune if of_model else given.train_head
            assert group["peak_lr"] == section.lr
    lora = {n for n in made.learning if n.startswith("vlm.")}
    assert lora
    assert all("lora_" in name for name in lora)
    before = weights(made.module)
    made.fit()
    after = weights(made.module)
    assert [n for n in before if torch.equal(before[n], after[n])] == []
    losses = made.history.tensor()[:, made.history.columns.index("loss")]
    assert losses[-6:].mean() < 0.7 * losses[:6].mean()
    assert sum(len(draw.ticks) for draw in plans[-1]) == 3, "its own limit of val ticks"


def test_what_is_kept_is_the_averaged_model_that_was_judged(params, tmp_path):
    """Extracted with the adapter, features are the live ones, and the policy takes them."""
    given = params(finetune={"max_steps": 4, "eval_every": 4, "eval_ticks": 100})
    made = trainer(given)
    made.fit()
    output = given.finetune.output
    assert {path.name for path in (output / "best" / "adapter").iterdir()} == {
        "adapter_config.json",
        "adapter_model.safetensors",
        "tuned_on.json",
    }
    adapter = str(output / "best" / "adapter")
    store, base = extracted_with(given, tmp_path / "tuned.zarr", adapter=adapter), made.store
    assert store.spec["digest"] != base.spec["digest"]
    # What it was tuned on goes along with the features, and is no part of what they are.
    tuned = read_tuned_on(output / "best" / "adapter")
    assert tuned is not None
    assert tuned_on_of_store(store.attrs, store.path) == tuned
    assert tuned_on_of_store(base.attrs, base.path) is None
    listed = load_policy(find_policy(output)).split
    for side in ("train", "val"):
        told = {part.episode: part.content for part in getattr(tuned, side)}
        assert told == {name: part.content for name, part in listed[side].items()}
    assert refuse_tuned_episodes(store, made.split) == []
    (output / "best" / "adapter" / "tuned_on.json").unlink()
    vlm = given.vlm.model_copy(update={"adapter": adapter})
    silent = feature_spec(vlm, store.spec["storage_dtype"], store.spec["views"], file_digest)
    assert silent.digest == store.spec["digest"]

    ticks = np.arange(0, store.ticks, 4)
    averaged = made.averaged
    assert isinstance(averaged, LivePolicy)
    assert averaged.vlm is not None
    with made.source.feed([BatchIndices(ticks)], Windows(2, 1, 1), CPU) as feed, torch.no_grad():
        _, batch = next(iter(feed))
        features, _ = averaged.vlm(batch.rows)
    cached = store.gather(ticks, 2, 1, 1).features
    torch.testing.assert_close(features[batch.row_of], cached, atol=5e-5, rtol=1e-3)
    noise = (features[batch.row_of] - cached).abs().max()
    assert (cached - base.gather(ticks, 2, 1, 1).features).abs().max() > 50 * noise

    # The policy's checkpoint says whose features it takes, and is judged on them as in training.
    with pytest.raises(CheckpointMismatch, match=r"feature_spec\.adapter"):
        check_store(load_policy(find_policy(output)), base)
    assert_judged_as_in_training(output, store)


def test_an_adapter_learns_through_the_pooler_that_reads_its_tokens(params, tmp_path):
    """Stage two reads the tuned model's own store by the same queries."""
    given = params(
        vlm={"pooling": ["tokens"], "layers": [0, -1]},
        extract={"store": str(tmp_path / "tokens.zarr")},
        train_head={
            "robot_state_enabled": True,
            "feature_encoder": {"kind": "pooler", "queries": 2, "dim": 8, "heads": 2, "layers": 1},
        },
        finetune={"max_steps": 2, "eval_every": 2, "eval_ticks": 100},
    )
    extract(given, say=lambda _: None)
    made = trainer(given)
    draws = [BatchIndices(np.arange(6))]
    with made.source.feed(draws, Windows.of(made.params), CPU) as feed:
        _, batch = next(iter(feed))
        made.module.loss(batch, batch.action, batch.action_valid)[0].backward()
    parts = dict(made.module.named_parameters())
    reader = {n: p for n, p in parts.items() if n.startswith("policy.encoders.features.")}
    assert isinstance(made.source.policy_of(made.module).encoders["features"], FeaturePooler)
    still = {n.removeprefix("policy.encoders.features.") for n, p in reader.items() if not moves(p)}
    assert still == {"missing", "steer.weight", "steer.bias"}  # no row is missing, the gate is 0
    # The other half of an adapter gets gradients when this half is no longer 0.
    adapters = [p for n, p in parts.items() if "lora_B" in n]
    assert adapters and all(map(moves, adapters))

    made.fit()
    adapter = str(given.finetune.output / "best" / "adapter")
    tuned = extracted_with(given, tmp_path / "tuned.zarr", adapter=adapter)
    assert_judged_as_in_training(given.finetune.output, tuned)


def test_a_run_goes_on_from_any_checkpoint_to_the_same_bits(params, tmp_path, stop_at):
    whole = trainer(params(finetune={"output": str(tmp_path / "whole"), "max_steps": 4}))
    whole.fit()
    given = params(finetune={"output": str(tmp_path / "stopped"), "max_steps": 4})
    stop_at(trainer(given), 3)
    resumed = trainer(given)
    assert (resumed.run.status, resumed.step) == ("resumed", 2)
    resumed.fit()
    assert torch.equal(resumed.history.tensor(), whole.history.tensor())
    for which in ("best", "last"):
        one, other = (learned(tmp_path / run, which) for run in ("whole", "stopped"))
        assert one.keys() == other.keys()
        assert all(torch.equal(one[name], other[name]) for name in one)


def test_a_setting_that_decides_the_numbers_is_another_run(store, params):
    before = ModelFeatureSource(store, params(), CPU).identity
    json.dumps(before)
    small = {"lora_r": 4, "lora_alpha": 8}
    for changed, another in (
        ({"lr": 2e-3}, True),
        ({"tuning": {**small, "towers": ["vision"]}}, True),
        ({"tuning": {**small, "gradient_checkpointing": False}, "decode_threads": 1}, False),
    ):
        after = ModelFeatureSource(store, params(finetune=changed), CPU).identity
        assert (before != after) == another, changed


def test_full_tuning_saves_a_checkpoint_to_extract_with(params, tmp_path):
    given = params(finetune={"tuning": {"method": "full"}, "max_steps": 1, "lr": 1e-4})
    made = trainer(given)
    made.fit()
    best = given.finetune.output / "best"
    checkpoint = str(best / "checkpoint")
    store = extracted_with(given, tmp_path / "full.zarr", checkpoint=checkpoint)
    check_store(load_policy(best), store)


def test_the_tuned_features_of_a_projected_store_keep_its_basis(params, tmp_path):
    """The tuned policy, whose model learned on that basis, fits the store of the command."""
    projected = {"store": str(tmp_path / "few.zarr"), "dtype": {"pca": 12, "then": "float16"}}
    given = params(extract=projected, finetune={"max_steps": 1})
    extract(given, say=lambda _: None)
    made = trainer(given)
    made.fit()
    said = next_steps(given.finetune, made.store)
    assert said[-1].startswith(f"the model was tuned on the basis of {made.store.path}, ")
    file = tmp_path / "params.yaml"
    file.write_text(yaml.safe_dump(given.model_dump(mode="json")))
    printed = next(line for line in said if "stages.extract" in line)
    overrides = [option for option in shlex.split(printed) if "=" in option]
    extract(load_params(file, overrides), say=lambda _: None)
    check_store(
        load_policy(find_policy(given.finetune.output)),
        FeatureStore.open(tmp_path / "few_tuned.zarr"),
    )


def test_a_gpu_that_is_too_small_ends_in_what_takes_less():
    with pytest.raises(ConfigError, match=r"finetune\.grad_accumulation"), out_of_memory_named():
        raise torch.cuda.OutOfMemoryError("tried to allocate 2.00 GiB")
