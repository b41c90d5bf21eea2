"""Reads the evaluations of several experiments back, if they may be compared in one table."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, JsonValue

from pipeline.base.config import FusionStrategy, ModelType
from pipeline.base.differences import describe, differences
from pipeline.base.documents import Border, Document, Text
from pipeline.base.errors import ConfigError
from pipeline.base.text import Table
from pipeline.evaluate.baselines import BASELINES, METHODS
from pipeline.evaluate.evaluation import JUDGED
from pipeline.evaluate.figures import Figure, draws
from pipeline.evaluate.tables import GROUPS, HEADINGS

SPANS = {"executed": "what is executed", "overall": "the whole chunk"}
"""The parts of a chunk that are judged: the name in `GROUPS`, and the words for it."""
_REPORT = Border(
    ConfigError,
    "compare.reports takes the output of stages.evaluate: evaluate that experiment again with this "
    "version, or move its folder away.",
)


class JudgedPolicy(Document):
    """The part of `JudgedDocument` about the policy."""

    model_type: ModelType
    fusion_strategy: FusionStrategy
    parameters: Annotated[int, Field(ge=0)]
    samples: Annotated[int, Field(ge=1)]
    seed: int
    recipe: Text
    """Equal for trainings that differ only in their seed or fold."""


class JudgedOn(Document):
    """What the policy was evaluated on; all entries are compared."""

    model_config = ConfigDict(extra="allow")
    test: dict[Text, JsonValue]


class JudgedDocument(Document):
    """The content of `JUDGED`, as `judged_document` writes it."""

    policy: JudgedPolicy
    on: JudgedOn
    drawn: dict[Text, int] | None


@dataclass(frozen=True, eq=False)
class Experiment:
    """The evaluations, read back, of policies whose trainings differ only in their seed or fold."""

    name: str
    judged: JudgedDocument
    """The document of the first of them; its `test` is that of all folds."""
    seeds: tuple[int, ...]
    groups: tuple[str, ...]
    """Groups of test recordings of all folds, in order."""
    entries: Mapping[str, NDArray[np.float64]]
    """By one of `SPANS`: (group,) number of recorded actions that were judged."""
    errors: Mapping[tuple[str, str], NDArray[np.float64]]
    """By one of `METHODS` and one of `SPANS`: (seed, group) mean absolute error [training std]."""
    folds: int = 1
    """Number of evaluations that are taken together, each with other test groups."""

    def by_seed(self, span: str, method: str = "policy") -> NDArray[np.float64]:
        """(seed,) errors over all groups [training std]."""
        return np.average(self.errors[method, span], axis=1, weights=self.entries[span])

    def error(self, span: str, method: str = "policy") -> Figure:
        """The mean over the seeds; its interval is over groups of recordings only."""
        return Figure.of(float(self.by_seed(span, method).mean()), self._draws(span, method))

    def best_baseline(self, span: str) -> str:
        """The baseline with the lowest error."""
        return min(BASELINES, key=lambda method: self.by_seed(span, method).mean())

    def minus(self, other: "Experiment", span: str, method: str = "policy") -> Figure:
        """The policy's error minus that of another experiment's method, by the paired bootstrap."""
        value = self.by_seed(span).mean() - other.by_seed(span, method).mean()
        own, others = self._draws(span, "policy"), other._draws(span, method)
        return Figure.of(float(value), None if own is None or others is None else own - others)

    def _draws(self, span: str, method: str) -> NDArray[np.float64] | None:
        entries = self.entries[span]
        return draws(self.errors[method, span].mean(axis=0) * entries, entries)


def read_experiments(reports: Path) -> tuple[Experiment, ...]:
    """The evaluations in the folders of `reports`, ordered by name.

    Evaluations whose trainings differ only in their seed or fold are one experiment. Other folders,
    such as the logs of a training, are skipped. Raises `ConfigError` if there is no evaluation, if
    one lacks a file or cannot be read, if they were not evaluated on the same ticks (all folds
    together), or if stochastic policies were not sampled alike.
    """
    folders = [
        folder
        for folder in sorted(reports.glob("*"))
        if any((folder / name).exists() for name in (JUDGED, GROUPS))
    ]
    if not folders:
        raise ConfigError(
            f"compare.reports: expected one folder for each experiment in {reports}, each with a "
            f"{JUDGED}, found none. Run stages.evaluate for each with its own evaluate.output "
            "there, or bash experiments/experts.sh."
        )
    runs: dict[tuple[Any, ...], list[Experiment]] = {}
    for experiment in map(_read_experiment, folders):
        runs.setdefault((experiment.judged.policy.recipe, *experiment.seeds), []).append(experiment)
    experiments = list(chain.from_iterable(map(_pooled, runs.values())))
    for key in ("on", "drawn"):
        _check_shared(reports, experiments, key)
    of_recipe: dict[str, list[Experiment]] = {}
    for experiment in experiments:
        of_recipe.setdefault(experiment.judged.policy.recipe, []).append(experiment)
    return tuple(sorted(map(_merged, of_recipe.values()), key=lambda experiment: experiment.name))


def best_experiment(experiments: Sequence[Experiment], span: str) -> Experiment:
    """The experiment with the lowest error."""
    return min(experiments, key=lambda experiment: experiment.error(span).value)


def experiment_table(experiments: Sequence[Experiment], span: str) -> Table:
    """A row for each experiment and baseline, with mean absolute errors and their differences.

    Each baseline has its lowest error of all experiments: of other training recordings, or other
    features, it errs otherwise.
    """
    best = best_experiment(experiments, span)
    heading = f"{SPANS[span]} [training std]"
    rows: list[dict[str, Any]] = []
    for experiment in experiments:
        policy = experiment.judged.policy
        low, high = experiment.by_seed(span).min(), experiment.by_seed(span).max()
        baseline = experiment.best_baseline(span)
        apart = experiment.minus(experiment, span, baseline)
        row = {
            "experiment": experiment.name,
            heading: experiment.error(span).text(),
            "minus the best": _verdict(experiment.minus(best, span)),
            "minus the best baseline": f"{_verdict(apart)} ({HEADINGS[baseline]})",
            "over seeds": f"{low:.3f} to {high:.3f}" if len(experiment.seeds) > 1 else None,
            "seeds": len(experiment.seeds),
            "folds": experiment.folds,
            "expert": policy.model_type,
            "fusion": policy.fusion_strategy,
            "samples": policy.samples,
            "parameters": policy.parameters,
        }
        rows.append(row | ({"minus the best": "it is"} if experiment is best else {}))
    for method in BASELINES:
        errors = (experiment.error(span, method) for experiment in experiments)
        lowest = min(errors, key=lambda error: error.value).text()
        named = {"experiment": f"baseline: {HEADINGS[method]}", heading: lowest}
        rows.append(dict.fromkeys(rows[0]) | named)
    return Table.of(rows)


def experiment_csv(experiments: Sequence[Experiment]) -> Table:
    """A row for each experiment, with the numbers of both spans in columns."""
    own = ("model_type", "fusion_strategy", "parameters", "samples")
    rows: list[dict[str, Any]] = []
    for experiment in experiments:
        row: dict[str, Any] = {"experiment": experiment.name}
        row |= {key: getattr(experiment.judged.policy, key) for key in own}
        row["seeds"] = " ".join(map(str, experiment.seeds))
        row["folds"] = experiment.folds
        for span in SPANS:
            baseline = experiment.best_baseline(span)
            best = best_experiment(experiments, span)
            row |= experiment.error(span).columns(span)
            row[f"{span}_seed_min"] = experiment.by_seed(span).min()
            row[f"{span}_seed_max"] = experiment.by_seed(span).max()
            row |= _apart(f"{span}_minus_best", experiment.minus(best, span))
            row[f"{span}_best_baseline"] = baseline
            row |= _apart(f"{span}_minus_baseline", experiment.minus(experiment, span, baseline))
            row |= {f"{span}_{way}": experiment.by_seed(span, way).mean() for way in BASELINES}
        rows.append(row)
    return Table.of(rows)


def _verdict(apart: Figure) -> str:
    """A difference, and whether it is resolved."""
    return f"{apart.text('+')}: {apart.verdict}" if apart.verdict else apart.text("+")


def _apart(name: str, apart: Figure) -> dict[str, Any]:
    return {**apart.columns(name), f"{name}_is": apart.verdict}


def _pooled(run: Sequence[Experiment]) -> Sequence[Experiment]:
    """Join the evaluations of one training's folds into one, with the test groups of all.

    If two of them share a test group, they are not folds and stay as they are.
    """
    first, *others = run
    groups = np.array([group for fold in run for group in fold.groups])
    if not others or len(set(groups)) < len(groups):
        return run
    order = np.argsort(groups)

    def together(parts: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        return np.concatenate(parts, axis=-1)[..., order]

    test = {name: part for fold in run for name, part in fold.judged.on.test.items()}
    on = first.judged.on.model_copy(update={"test": test})
    pooled = replace(
        first,
        name=_less_number(first.name),
        judged=first.judged.model_copy(update={"on": on}),
        groups=tuple(groups[order].tolist()),
        entries={span: together([fold.entries[span] for fold in run]) for span in SPANS},
        errors={key: together([fold.errors[key] for fold in run]) for key in first.errors},
        folds=len(run),
    )
    return [pooled]


def _merged(of_seeds: Sequence[Experiment]) -> Experiment:
    """Join evaluations of one recipe into one experiment, named as the first without its seed."""
    first, *others = of_seeds
    if not others:
        return first
    return replace(
        first,
        name=_less_number(first.name),
        seeds=tuple(seed for experiment in of_seeds for seed in experiment.seeds),
        errors={key: np.concatenate([e.errors[key] for e in of_seeds]) for key in first.errors},
    )


def _less_number(name: str) -> str:
    """A folder's name without the seed and the fold at its end."""
    return re.sub(r"([-_]?(seed|fold)[-_]?\d+)+$|[-_]?\d+$", "", name) or name


def _read_experiment(folder: Path) -> Experiment:
    """The experiment of one seed and fold."""
    judged = _REPORT.read_json(folder / JUDGED, JudgedDocument)
    groups, numbers = _read_groups(folder / GROUPS)
    return Experiment(
        name=folder.name,
        judged=judged,
        seeds=(judged.policy.seed,),
        groups=groups,
        entries={span: numbers[f"{span}_entries"] for span in SPANS},
        errors={(way, span): numbers[f"{way}_{span}"][None] for way in METHODS for span in SPANS},
    )


def _read_groups(path: Path) -> tuple[tuple[str, ...], dict[str, NDArray[np.float64]]]:
    """The names of the groups, and the columns (group,) that are compared."""
    columns = [f"{span}_entries" for span in SPANS]
    columns += [f"{way}_{span}" for way in METHODS for span in SPANS]
    try:
        rows = list(csv.DictReader(_REPORT.read_bytes(path).decode().splitlines()))
        numbers = {name: np.array([float(row[name]) for row in rows]) for name in columns}
        groups = tuple(row["group"] for row in rows)
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        raise _REPORT.refusal(path, f"expected a number in each column: {error}") from None
    for name, values in numbers.items():
        if not (np.isfinite(values) & (values >= 0)).all():
            raise _REPORT.refusal(path, f"{name}: expected finite numbers of at least 0")
    if len(set(groups)) < max(1, len(groups)):
        raise _REPORT.refusal(path, "expected a row for each group, each once")
    return groups, numbers


def _check_shared(reports: Path, experiments: Sequence[Experiment], key: str) -> None:
    """Raise `ConfigError` where evaluations that have this entry of their document differ in it."""
    documents = [(e.name, e.judged.model_dump(mode="json")[key]) for e in experiments]
    for (name, entry), (other_name, other) in pairwise(pair for pair in documents if pair[1]):
        if differing := differences(entry, other):
            lines = [f"  {line} ({other_name})" for line in describe(differing, f" ({name}), ")]
            raise ConfigError(
                f"compare.reports: expected evaluations in {reports} on the same test ticks, all "
                "folds together, from as many samples and ticks a batch, but:\n"
                + "\n".join(lines)
                + "\nEvaluate all of them with the same recordings, folds, evaluate.samples and "
                "evaluate.batch_size, or move those that do not belong away."
            )
