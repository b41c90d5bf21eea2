"""A policy evaluated on its test ticks, and the document that says what was evaluated on what."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.spatial.distance import cdist, pdist

from pipeline.base.channels import action_groups
from pipeline.base.config import EvaluateParams
from pipeline.base.errors import ConfigError
from pipeline.data.contact import contact_spans, force_columns
from pipeline.evaluate.ablation import AblationStudy, evaluate_ablation
from pipeline.evaluate.baselines import Baselines
from pipeline.evaluate.figures import Figure, mean_over_ticks
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.policy import Trainable
from pipeline.store import Episode, FeatureStore
from pipeline.train.batches import Ticks, Windows
from pipeline.train.predictions import Actions, Predictions, predict
from pipeline.train.run import FREE_PARAMS
from pipeline.train.scores import Comparison, action_space, compare
from pipeline.train.split import hash64
from pipeline.train.training_data import find_ticks, groups_of, source_of

JUDGED = "judged.json"
"""The document's name in the folder of an evaluation, beside metrics.json."""
MEAN, BEST = "mean of n", "best of n"
ENERGY = "energy score"
APPROACH, CONTACT, HOLD = PHASES = ("approach", "contact", "hold")
PHASE_RULE = (
    "approach: out of contact by the force; contact: in it, moving; hold: in it, and the recorded "
    "motion of the tick is below half of its median in the contacts of that recording"
)
_HOLD = 0.5
"""A tick in contact is at hold if its motion is below this share of the usual motion there."""


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


def evaluate_checkpoint(
    folder: Path,
    checkpoint: PolicyCheckpoint,
    store: FeatureStore,
    wanted: EvaluateParams,
    device: torch.device,
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
    features = checkpoint.statistics("features") if checkpoint.normalization.features else None
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


class SampledChunks:
    """Collects the samples of a policy batch by batch; the `watch` of `predict`.

    `scale` (action_dim,) is that of `Comparison`: a dimension that does not vary in training has no
    weight.
    """

    def __init__(self, scale: Float[np.ndarray, " action_dim"]) -> None:
        counted = scale > 0 if (scale > 0).any() else np.ones_like(scale, np.bool_)
        self._per_std = np.where(counted, 1 / np.where(scale > 0, scale, 1), 0.0)
        self._mean: list[Actions] = []
        self._best: list[Actions] = []
        self._energy: list[Float[np.ndarray, " tick"]] = []

    def __call__(
        self,
        chunks: Float[np.ndarray, "sample tick horizon action_dim"],
        recorded: Float[np.ndarray, "tick horizon action_dim"],
        valid: Bool[np.ndarray, "tick horizon"],
    ) -> None:
        if len(chunks) < 2:
            return
        self._mean.append(chunks.mean(axis=0))
        errors = np.abs(chunks - recorded) @ self._per_std
        best = np.where(valid, errors, 0.0).sum(axis=2).argmin(axis=0)
        self._best.append(chunks[best, np.arange(len(best))])
        pairs = zip(chunks.swapaxes(0, 1), recorded, valid, strict=True)
        self._energy.append(np.array([self._score(*pair) for pair in pairs]))

    def chunks(self) -> dict[str, Actions]:
        """The mean and the best of the samples, (tick, horizon, action_dim); empty with one sample.

        The best has the lowest error over the valid entries. Only the recorded actions tell which
        one it is, so it shows what the samples contain, not what a robot would do.
        """
        ways = {MEAN: self._mean, BEST: self._best}
        return {name: np.concatenate(parts) for name, parts in ways.items() if parts}

    def energy(self) -> Float[np.ndarray, " tick"]:
        """The energy score of each tick's samples; empty with one sample.

        Gneiting and Raftery (2007), eq. 21 with beta 1, negated so that lower is better: the mean
        distance to the recorded chunk, minus half the mean distance between two different samples.
        A distance is Euclidean over the valid entries of the chunk in training std, divided by the
        square root of their number: for a single sample, its root mean square error.
        """
        return np.concatenate(self._energy) if self._energy else np.empty(0)

    def _score(
        self,
        chunks: Float[np.ndarray, "sample horizon action_dim"],
        recorded: Float[np.ndarray, "horizon action_dim"],
        valid: Bool[np.ndarray, " horizon"],
    ) -> float:
        # Dimensions without weight are zero in all samples and add to no distance.
        samples = (chunks[:, valid] * self._per_std).reshape(len(chunks), -1)
        truth = (recorded[valid] * self._per_std).reshape(1, -1)
        distance = cdist(samples, truth).mean() - pdist(samples).mean() / 2
        return float(distance / np.sqrt(valid.sum() * np.count_nonzero(self._per_std)))


def phases_of(store: FeatureStore, ticks: Ticks) -> NDArray[np.str_]:
    """(tick,) one of `PHASES`, or empty where the recording has no force."""
    phases = np.full(len(ticks), "", dtype="<U8")
    names = store.streams["sensor"]["names"]
    if columns := force_columns(names):
        episodes = store.episode_of(ticks)
        for index in np.unique(episodes):
            here, episode = episodes == index, store.episodes[index]
            phases[here] = _phases(store, episode, columns)[ticks[here] - episode.ticks.start]
    return phases


def _phases(store: FeatureStore, episode: Episode, columns: list[int]) -> NDArray[np.str_]:
    """(tick,) the phase of each tick of an episode."""
    first, stop = store.array("episode/sensor_start")[episode.index :][:2]
    time = store.array("sensor/time")[first:stop]
    phases = np.full(len(episode.ticks), APPROACH if len(time) else "", dtype="<U8")
    units = {store.streams["sensor"]["units"][column] for column in columns}
    force = store.array("sensor/values")[first:stop, columns]
    step_s = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    at = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    touching = np.zeros(len(at), np.bool_)
    for begin, end in contact_spans(time, force, units == {"N"}, step_s):
        touching |= (begin <= at) & (at <= end)
    if touching.any():
        motion = _motion(store, episode)
        still = motion < _HOLD * np.median(motion[touching])
        phases[touching] = np.where(still, HOLD, CONTACT)[touching]
    return phases


def _motion(store: FeatureStore, episode: Episode) -> NDArray[np.floating]:
    """(tick,) the length of each recorded motion: of the translation, else of all but grippers.

    The motion of an absolute action is its difference from the previous action.
    """
    action = store.streams["action"]
    groups = np.array(action_groups(action["names"], action["units"]))
    moving = groups == "translation" if "translation" in groups else groups != "gripper"
    values = store.array("tick/action")[episode.ticks.start : episode.ticks.stop, moving]
    if action["kind"] == "absolute":
        values = np.diff(values, axis=0, prepend=values[:1])
    return np.linalg.norm(values, axis=1)
