"""Evaluations of several experiments, read back where they may stand in one table."""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

from pipeline.base.config import FusionStrategy, ModelType
from pipeline.base.differences import describe, differences
from pipeline.base.errors import ConfigError
from pipeline.base.table import Table
from pipeline.evaluate.baselines import BASELINES, METHODS
from pipeline.evaluate.evaluation import JUDGED
from pipeline.evaluate.names import with_unit
from pipeline.evaluate.tables import ERRORS, HEADINGS, OVERALL
from pipeline.train.log import speed_file
from pipeline.train.scores import ActionGroup

_OVERALL = (OVERALL, "training std")
_SAME = 1e-4
"""Relative difference of two baselines that rounding on another machine explains."""
_SHARED = {
    "on": ("on the same test ticks", "recordings"),
    "drawn": ("from as many samples and ticks a batch", "evaluate.samples and evaluate.batch_size"),
}
"""By key of `JUDGED`: how evaluations in one table are alike, and by what they become so."""


@dataclass(frozen=True)
class Experiment:
    """One evaluation, read back."""

    name: str
    model_type: str
    fusion_strategy: str
    step: int
    parameters: int
    samples: int
    errors: Mapping[tuple[str, str], Mapping[str, float]]
    """Name and unit of `OVERALL` and each action group -> error of the policy and each baseline."""
    training_s: float | None
    """Time that its training took; None where its speed file is not there."""

    @property
    def overall(self) -> Mapping[str, float]:
        """The overall errors [training std] of the policy and each baseline."""
        return self.errors[_OVERALL]

    @property
    def error(self) -> float:
        """The policy's overall error."""
        return self.overall["policy"]

    @property
    def relative(self) -> float | None:
        """It, divided by that of the best baseline."""
        best = min(self.overall[method] for method in BASELINES)
        return self.error / best if best > 0 else None


def read_experiments(reports: Path) -> tuple[Experiment, ...]:
    """The evaluations in the folders of `reports`, ordered by expert, fusion and name.

    What else lies there, such as the logs of a training, is passed over. Raises `ConfigError`
    where there is none, where one lacks a file or cannot be read, where they were not evaluated on
    the same ticks, and where stochastic policies were not sampled alike.
    """
    folders = [
        folder
        for folder in sorted(reports.glob("*"))
        if any((folder / name).exists() for name in (JUDGED, ERRORS))
    ]
    if not folders:
        raise ConfigError(
            f"compare.reports: expected one folder for each experiment in {reports}, each with a "
            f"{JUDGED}, found none. Run stages.evaluate for each with its own evaluate.output "
            "there, or dvc repro experiments/dvc.yaml."
        )
    documents, experiments = zip(*(_read_experiment(folder) for folder in folders), strict=True)
    for key, (alike, remedy) in _SHARED.items():
        pairs = zip(experiments, documents, strict=True)
        shared = [(one.name, document[key]) for one, document in pairs if document[key] is not None]
        for (name, what), (other, other_what) in pairwise(shared):
            if differing := differences(what, other_what):
                lines = [f"  {line} ({other})" for line in describe(differing, f" ({name}), ")]
                raise ConfigError(
                    f"compare.reports: expected evaluations {alike} in {reports}, but:\n"
                    + "\n".join(lines)
                    + f"\nEvaluate all of them with one {remedy}, or move those that do not belong "
                    "away."
                )
    for experiment, other in pairwise(experiments):
        _check_baselines(reports, experiment, other)
    return tuple(sorted(experiments, key=_order))


def experiment_table(experiments: Sequence[Experiment], trained: bool = False) -> Table:
    """An experiment a row, a baseline a row; mean absolute errors.

    `samples` are the chunks a tick whose mean was evaluated; `trained` adds the time that each
    training took.
    """
    groups = list(experiments[0].errors)
    own = ["policy / best", "expert", "fusion", "samples", "parameters", "trained [s]"]
    rows: list[list[Any]] = []
    for experiment in experiments:
        errors = (experiment.errors[group]["policy"] for group in groups)
        kind = (experiment.model_type, experiment.fusion_strategy, experiment.samples)
        rows.append([experiment.name, *errors, experiment.relative, *kind, experiment.parameters])
        seconds = experiment.training_s
        rows[-1].append(None if seconds is None else round(seconds))
    for method in BASELINES:
        errors = (experiments[0].errors[group][method] for group in groups)
        rows.append([f"baseline: {HEADINGS[method]}", *errors, None, "", "", None, None, None])
    heads = ["experiment", *(with_unit(*group) for group in groups), *own]
    stop = len(heads) if trained else -1
    return Table(heads[:stop], [row[:stop] for row in rows])


def experiment_csv(experiments: Sequence[Experiment]) -> Table:
    """For a file, without the time of training: what the clock says is never tracked."""
    errors = {
        f"{_key(group)}_{method}": (group, method)
        for group in experiments[0].errors
        for method in METHODS
    }
    own = ("model_type", "fusion_strategy", "step", "parameters", "samples")
    rows = [
        [
            experiment.name,
            *(getattr(experiment, key) for key in own),
            *(experiment.errors[group][method] for group, method in errors.values()),
        ]
        for experiment in experiments
    ]
    return Table(["experiment", *own, *errors], rows)


def _key(group: tuple[str, str]) -> str:
    """A group of `errors` as one word of a file."""
    return OVERALL if group == _OVERALL else ActionGroup(*group, ()).key


def _read_experiment(folder: Path) -> tuple[dict[str, Any], Experiment]:
    """What `JUDGED` says, and the experiment."""
    file = folder / ERRORS
    try:
        rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
        errors = {
            (row["group"], row["unit"]): {method: float(row[method]) for method in METHODS}
            for row in rows
        }
        errors = {_OVERALL: errors.pop(_OVERALL), **errors}
        file = folder / JUDGED
        document = json.loads(file.read_text(encoding="utf-8"))
        policy = dict(document["policy"])
        seconds = _training_seconds(Path(policy.pop("logs")))
        experiment = Experiment(folder.name, errors=errors, training_s=seconds, **policy)
        return {key: document[key] for key in _SHARED}, experiment
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"compare.reports: expected the output of stages.evaluate in {folder}, but {file.name} "
            f"cannot be read ({type(error).__name__}: {error}). Evaluate that experiment again "
            "with this version, or move the folder away."
        ) from None


def _training_seconds(logs: Path) -> float | None:
    """What the speed file beside these logs says that the training took; None without it."""
    path = speed_file(logs)
    if not path.exists():
        return None
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines(), delimiter="\t"))
    return float(rows[-1]["trained_s"]) if rows and rows[-1].get("trained_s") else None


def _check_baselines(reports: Path, experiment: Experiment, other: Experiment) -> None:
    for group, errors in experiment.errors.items():
        for method in BASELINES:
            error = other.errors.get(group, {}).get(method, math.nan)
            if not math.isclose(errors[method], error, rel_tol=_SAME, abs_tol=1e-9):
                raise ConfigError(
                    f"compare.reports: expected the same baselines in all evaluations in "
                    f"{reports}, found {method} ({_key(group)}) {errors[method]} in "
                    f"{experiment.name} and {error} in {other.name}: they were trained on other "
                    "recordings. Train and evaluate all of them on one store, or move those that "
                    "do not belong away."
                )


def _order(experiment: Experiment) -> tuple[int, int, str]:
    """The order of params.yaml's choices."""
    experts, fusions = get_args(ModelType), get_args(FusionStrategy)
    expert, fusion = experiment.model_type, experiment.fusion_strategy
    return experts.index(expert), fusions.index(fusion), experiment.name
