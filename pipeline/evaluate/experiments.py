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
from pipeline.base.errors import ConfigError
from pipeline.evaluate.evaluation import JUDGED
from pipeline.evaluate.tables import ERRORS, OVERALL
from pipeline.policy.checkpoint import describe, differences
from pipeline.train.log import speed_file
from pipeline.train.predictions import BASELINES, METHODS
from pipeline.train.scores import ActionGroup

_OVERALL = (OVERALL, "training std")
_SAME = 1e-4
"""Relative difference of two baselines that rounding on another machine explains."""


@dataclass(frozen=True)
class _Shared:
    """What evaluations in one table share, and what to do where they do not."""

    expected: str
    remedy: str


_SAME_TICKS = _Shared(
    "evaluations on the same held-out ticks", "Evaluate all of them on the same recordings"
)
_SAMPLED_ALIKE = _Shared(
    "evaluations of stochastic policies from as many samples and ticks a batch",
    "Evaluate all of them with one evaluate.samples and evaluate.batch_size",
)


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

    @staticmethod
    def key(group: tuple[str, str]) -> str:
        """A group of `errors` as one word of a file."""
        return OVERALL if group == _OVERALL else ActionGroup(*group, ()).key

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
    where there is none, where one lacks a file or cannot be read, where they were not judged on the
    same ticks, and where stochastic policies were not sampled alike.
    """
    folders = [path for path in sorted(reports.glob("*")) if _is_evaluation(path)]
    if not folders:
        raise ConfigError(
            f"compare.reports: expected one folder for each experiment in {reports}, each with a "
            f"{JUDGED}, found none. Run stages.evaluate for each with its own evaluate.output "
            "there, or dvc repro experiments/dvc.yaml."
        )
    judged = [_read(folder, JUDGED, "policy", "drawn", "on") for folder in folders]
    named = [(folder.name, what) for folder, what in zip(folders, judged, strict=True)]
    _check_same(reports, "on", named, _SAME_TICKS)
    sampled = [(name, what) for name, what in named if what["drawn"] is not None]
    _check_same(reports, "drawn", sampled, _SAMPLED_ALIKE)
    found = [
        _experiment(folder, what["policy"]) for folder, what in zip(folders, judged, strict=True)
    ]
    for one, other in pairwise(found):
        _check_baselines(reports, one, other)
    return tuple(sorted(found, key=_order))


def training_seconds(logs: Path) -> float | None:
    """What the speed file beside these logs says that the training took; None without it."""
    path = speed_file(logs)
    if not path.exists():
        return None
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines(), delimiter="\t"))
    return float(rows[-1]["trained_s"]) if rows and rows[-1].get("trained_s") else None


def _is_evaluation(folder: Path) -> bool:
    """Whether stages.evaluate wrote to it, even if one of its files is gone."""
    return any((folder / name).exists() for name in (JUDGED, ERRORS))


def _experiment(folder: Path, policy: Mapping[str, Any]) -> Experiment:
    try:
        return Experiment(
            name=folder.name,
            errors=_errors(folder),
            training_s=training_seconds(Path(policy["logs"])),
            **{key: value for key, value in policy.items() if key != "logs"},
        )
    except (KeyError, TypeError) as error:
        raise ConfigError(_no_evaluation(folder, f"it lacks {error}")) from None


def _errors(folder: Path) -> dict[tuple[str, str], dict[str, float]]:
    """Of `OVERALL`, which comes first, and each action group, by method."""
    rows = csv.DictReader(_text(folder, ERRORS).splitlines())
    try:
        errors = {
            (row["group"], row["unit"]): {method: float(row[method]) for method in METHODS}
            for row in rows
        }
    except ValueError as error:
        raise ConfigError(_no_evaluation(folder, f"{ERRORS} cannot be read: {error}")) from None
    return {_OVERALL: errors.pop(_OVERALL), **errors}


def _check_same(
    reports: Path, key: str, judged: Sequence[tuple[str, Mapping[str, Any]]], same: _Shared
) -> None:
    for (one, what), (other, what_other) in pairwise(judged):
        differing = differences(what[key], what_other[key])
        if differing:
            raise ConfigError(
                f"compare.reports: expected {same.expected} in {reports}, but they differ:\n"
                f"{describe(differing, one, other)}\n"
                f"{same.remedy}, or move those that do not belong away."
            )


def _check_baselines(reports: Path, one: Experiment, other: Experiment) -> None:
    for group, errors in one.errors.items():
        for method in BASELINES:
            found = other.errors.get(group, {}).get(method, math.nan)
            if not math.isclose(errors[method], found, rel_tol=_SAME, abs_tol=1e-9):
                raise ConfigError(
                    f"compare.reports: expected the same baselines in all evaluations in "
                    f"{reports}, found {method} ({one.key(group)}) {errors[method]} in {one.name} "
                    f"and {found} in {other.name}: they were trained on other recordings. Train "
                    "and evaluate all of them on one store, or move those that do not belong away."
                )


def _read(folder: Path, name: str, *keys: str) -> dict[str, Any]:
    text = _text(folder, name)
    try:
        document = json.loads(text)
    except ValueError as error:
        raise ConfigError(_no_evaluation(folder, f"{name} is no JSON: {error}")) from None
    lacking = [key for key in keys if key not in document]
    if lacking:
        raise ConfigError(_no_evaluation(folder, f"it lacks {lacking[0]!r} in {name}"))
    return document


def _text(folder: Path, name: str) -> str:
    try:
        return (folder / name).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(_no_evaluation(folder, f"it has no {name}")) from None


def _no_evaluation(folder: Path, why: str) -> str:
    return (
        f"compare.reports: expected the output of stages.evaluate in {folder}, but {why}. Evaluate "
        "that experiment again with this version, or move the folder away."
    )


def _order(experiment: Experiment) -> tuple[int, int, str]:
    places = [
        names.index(name) if name in names else len(names)
        for names, name in (
            (get_args(ModelType), experiment.model_type),
            (get_args(FusionStrategy), experiment.fusion_strategy),
        )
    ]
    return places[0], places[1], experiment.name
