"""A policy evaluated on its test ticks, and the document that says what was evaluated on what."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pipeline.base.config import EvaluateParams
from pipeline.base.errors import ConfigError
from pipeline.evaluate.ablation import AblationStudy, evaluate_ablation
from pipeline.evaluate.baselines import Baselines
from pipeline.evaluate.curves import TrainingCurves, read_curves
from pipeline.evaluate.figures import Figure, mean_over_ticks
from pipeline.evaluate.phases import phases_of
from pipeline.evaluate.samples import SampledChunks
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.policy import Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.predictions import Predictions, predict
from pipeline.train.run import FREE_PARAMS
from pipeline.train.scores import Comparison, action_space, compare
from pipeline.train.split import hash64
from pipeline.train.training_data import find_ticks, groups_of, source_of

JUDGED = "judged.json"
"""The document's name in the folder of an evaluation, beside metrics.json."""


@dataclass(frozen=True)
class Evaluation:
    """A policy and the results of its evaluation."""

    name: str
    """The name of the checkpoint, as the user wrote it."""
    checkpoint: PolicyCheckpoint
    store: FeatureStore
    comparison: Comparison
    predictions: Predictions
    energy: Figure | None
    """The energy score of the policy's samples; None if the policy does not sample."""
    study: AblationStudy | None
    judged: Mapping[str, Any]
    """What `judged_document` returns."""
    curves: TrainingCurves
    recordings: Path
    """The root of the relative paths of the store's recordings."""


def evaluate_checkpoint(
    folder: Path,
    checkpoint: PolicyCheckpoint,
    store: FeatureStore,
    wanted: EvaluateParams,
    device: torch.device,
    recordings: Path,
    say: Callable[[str], None],
) -> Evaluation:
    """Evaluate the policy of the checkpoint in `folder` on its test ticks in a store that it fits.

    `say` first prints what is evaluated on what. Raises `ConfigError` if more steps would be
    executed than a chunk has, `CheckpointMismatch` as `find_ticks` does, and `NumericsError` as
    `predict` does.
    """
    horizon = checkpoint.params.horizon
    if wanted.execute > horizon:
        raise ConfigError(
            f"evaluate.execute {wanted.execute}: expected at most the {horizon} steps of a chunk "
            "(train_head.horizon)"
        )
    names = checkpoint.split["test"].keys()
    ticks, checkpoint = find_ticks(store, checkpoint, "test")
    training, _ = find_ticks(store, checkpoint, "train")
    if renamed := names - checkpoint.split["test"].keys():
        say(f"test episodes renamed since the training: {len(renamed)}, told by their content")
    policy = checkpoint.policy(device)
    judged = judged_document(checkpoint, policy, store, wanted)
    say(
        f"{folder} (step {checkpoint.step}) on {len(ticks)} test ticks of "
        f"{len(checkpoint.split['test'])} episode(s) in {store.path}, device {device}, "
        f"{judged['policy']['samples']} chunk(s) a tick"
    )
    if note := trained_on_too(checkpoint):
        say(f"warning: {note}")
    features = checkpoint.normalization.features
    baselines = Baselines(store, training, horizon, features)
    space = action_space(store, checkpoint.normalization)
    groups = groups_of(store, checkpoint, ticks)
    sampled = SampledChunks(space[-1])
    seen = (policy, store, ticks, Windows.of(checkpoint.params), wanted.batch_size)
    predictions = predict(*seen, progress=True, samples=wanted.samples, watch=sampled)
    others = baselines.act(ticks) | sampled.chunks()
    phases = phases_of(store, ticks)
    comparison = compare(predictions, others, space, groups, phases, wanted.execute)
    study = None
    if wanted.modalities:
        rest = (ticks, baselines, wanted.batch_size, wanted.samples)
        study = evaluate_ablation(checkpoint, policy, store, *rest)
    energy = sampled.energy()
    return Evaluation(
        name=str(folder),
        checkpoint=checkpoint,
        store=store,
        comparison=comparison,
        predictions=predictions,
        energy=mean_over_ticks(energy, groups) if len(energy) else None,
        study=study,
        judged=judged,
        curves=read_curves(checkpoint),
        recordings=recordings,
    )


def trained_on_too(checkpoint: PolicyCheckpoint) -> str:
    """A note on test episodes whose earlier ticks were trained on; empty where there are none."""
    both = checkpoint.split["test"].keys() & checkpoint.split["train"].keys()
    return (
        f"{len(both)} test episode(s) were cut by time and trained on before that: "
        "this says less than recordings never seen"
        if both
        else ""
    )


def judged_document(
    checkpoint: PolicyCheckpoint, policy: Trainable, store: FeatureStore, wanted: EvaluateParams
) -> dict[str, Any]:
    """What was evaluated (`policy`), how it was sampled (`drawn`) and on what (`on`), as JSON.

    Evaluations may be in one table if their `on` is equal, whatever features the policies saw.
    Stochastic policies also need an equal `drawn`: the best of fewer samples errs more, and a batch
    shares its noise. `drawn` is null for policies that do not sample. The `recipe` is equal for
    trainings that differ only in their seed or fold.
    """
    params = checkpoint.params
    source = source_of(store)
    left_out = dict.fromkeys(FREE_PARAMS | {"seed"}, True) | {"split": {"fold"}}
    decides = params.model_dump(mode="json", exclude=left_out)
    recipe = [decides, source["feature_spec"]["digest"]]
    drawn = None
    if policy.stochastic:
        drawn = {"samples": wanted.samples, "batch_size": wanted.batch_size}
    return {
        "policy": {
            "model_type": params.model_type,
            "fusion_strategy": params.fusion_strategy,
            "step": checkpoint.step,
            "weights": checkpoint.digest,
            "parameters": sum(count for _, count in policy.parameter_table()),
            "samples": drawn["samples"] if drawn else 1,
            "seed": params.seed,
            "recipe": f"{hash64(json.dumps(recipe, sort_keys=True)):016x}",
        },
        "drawn": drawn,
        "feature_spec": source["feature_spec"]["digest"],
        "on": {
            "action": source["streams"]["action"],
            "action_hz": source["action_hz"],
            "vlm_reuse_count": source["vlm_reuse_count"],
            "horizon": params.horizon,
            "execute": wanted.execute,
            "test": {
                name: part.model_dump(mode="json")
                for name, part in checkpoint.split["test"].items()
            },
        },
    }
