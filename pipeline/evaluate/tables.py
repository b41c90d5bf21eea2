"""The figures of an evaluation as printed text, as `metrics.json` and as CSV files."""

from collections.abc import Mapping
from dataclasses import astuple
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.channels import named
from pipeline.base.files import write_document
from pipeline.base.text import Table
from pipeline.evaluate.ablation import AblationStudy
from pipeline.evaluate.baselines import METHODS
from pipeline.evaluate.evaluation import BEST, ENERGY, MEAN, PHASE_RULE, PHASES, Evaluation
from pipeline.evaluate.figures import (
    FEWEST_GROUPS,
    NO_INTERVAL,
    Figure,
    Rivalry,
    best_baseline,
    by_group,
    error,
    rivalry,
    sums_by_group,
    with_unit,
)
from pipeline.store import FeatureStore
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison

FOOTNOTE = (
    "linear fit: on the two actions before; nearest neighbour: the training tick most alike in "
    "state and features. Before an episode's first tick actions count as zero, or as the median "
    "where they are absolute"
)
ABLATION_FOOTNOTE = "zeroed: every value at its training mean, which the policy sees as zeros"
GROUPS = "groups.csv"
"""The file with the errors of all methods by group of test recordings."""
OVERALL = "overall"
_STD = "training std"
HEADINGS = {method: method.removesuffix("_action").replace("_", " ") for method in METHODS}


def scopes(comparison: Comparison) -> dict[str, Comparison]:
    """The comparison over the executed steps and over the whole chunk.

    If several steps are executed, the comparison over the first step alone is between them.
    """
    first = {"first_step": comparison.part(steps=slice(1))} if comparison.execute > 1 else {}
    return {"executed": comparison.executed, **first, "chunk": comparison}


def titles(comparison: Comparison) -> tuple[str, str]:
    """Titles for the executed steps and for the whole chunk; they name intervals or their lack."""
    horizon = comparison.cells.entries.shape[1]
    steps = "step 0" if comparison.execute == 1 else f"the first {comparison.execute} steps"
    ends = "with 95 % intervals" if _has_intervals(comparison) else "without intervals"
    return (
        f"what is executed, {steps} of {horizon}, {ends}",
        f"the whole chunk of {horizon} step(s), {ends}",
    )


def _has_intervals(comparison: Comparison) -> bool:
    return len(np.unique(comparison.cells.group)) >= FEWEST_GROUPS


def metrics(comparison: Comparison, energy: Figure | None = None) -> dict[str, Any]:
    """The content of `metrics.json`: the main numbers of an evaluation, in 6 significant digits.

    docs/reports.md describes it; all other numbers are in tables.
    """
    document: dict[str, Any] = {
        "test": {
            "episodes": len(comparison.episodes),
            "groups": len(np.unique(comparison.cells.group)),
            "ticks": comparison.ticks,
        }
    }
    for scope, part in scopes(comparison).items():
        varying = part.varying_groups()
        document[scope] = {OVERALL: _rivals(rivalry(part))}
        for group in part.groups:
            rivals = _rivals(rivalry(part, group))
            document[scope][group.key] = (
                rivals if group in varying else {"policy": rivals["policy"]}
            )
    if sampled := sample_figures(comparison, energy):
        document["samples"] = {n.replace(" ", "_"): f.document() for n, f in sampled.items()}
    if phases := by_phase(comparison):
        document["phases"] = {
            phase: {"ticks": part.ticks}
            | {scope: error(p, "policy").document() for scope, p in scopes(part).items()}
            for phase, part in phases.items()
        }
    return document


def headline(figures: Mapping[str, Any]) -> dict[str, float]:
    """The content of `headline.json`, which `dvc metrics` shows, of that of `metrics.json`."""
    return {
        f"{scope}_error{suffix}": figures[scope][OVERALL][who]["value"]
        for scope in ("executed", "chunk")
        for who, suffix in (("policy", ""), ("best_baseline", "_of_best_baseline"))
    }


def _rivals(rivals: Rivalry) -> dict[str, dict[str, float]]:
    figures = {"policy": rivals.policy, "best_baseline": rivals.baseline}
    return {n: f.document() for n, f in (figures | {"difference": rivals.difference}).items()}


def sample_figures(comparison: Comparison, energy: Figure | None) -> dict[str, Figure]:
    """The errors of one and of several samples, over the whole chunk; empty with one sample."""
    if MEAN not in comparison.scores or energy is None:
        return {}
    names = {"one": "policy", MEAN: MEAN, BEST: BEST}
    return {name: error(comparison, way) for name, way in names.items()} | {ENERGY: energy}


def by_phase(comparison: Comparison) -> dict[str, Comparison]:
    """The comparison on the ticks of each known phase."""
    return {p: comparison.of_phase(p) for p in PHASES if p in comparison.cells.phase}


def error_table(comparison: Comparison) -> Table:
    """Mean absolute errors with their intervals, the overall one first, a row for each method."""
    groups = (None, *comparison.groups)
    rows = [
        [HEADINGS[way], *(error(comparison, way, group).text() for group in groups)]
        for way in METHODS
    ]
    return Table(["mean absolute error", *map(_heading, groups)], rows, strong=frozenset({0}))


def difference_table(comparison: Comparison) -> Table:
    """Policy minus best baseline in each figure, and whether the difference is resolved."""
    rows: list[dict[str, Any]] = []
    for scope, part in scopes(comparison).items():
        for group in (*part.varying_groups(), None):
            rivals = rivalry(part, group)
            row = {"steps": scope.replace("_", " "), "error": _heading(group)}
            row |= {"the policy is": rivals.verdict, "policy / best": rivals.ratio}
            row |= {"policy minus best": rivals.difference.text("+")}
            row |= {"best baseline": HEADINGS[rivals.best], "its error": rivals.baseline.text()}
            rows.append(row)
    return Table.of(rows)


def phase_table(comparison: Comparison) -> Table:
    """Overall errors by phase, of the policy and of the baseline that is best there."""
    rows: list[dict[str, Any]] = []
    for phase, part in by_phase(comparison).items():
        row: dict[str, Any] = {"phase": phase}
        for scope, rivals in (("executed", rivalry(part.executed)), ("chunk", rivalry(part))):
            row[f"{scope}: the policy is"] = rivals.verdict
            row[f"{scope}: policy"] = rivals.policy.text()
            row[f"{scope}: best baseline"] = f"{rivals.baseline.text()} {HEADINGS[rivals.best]}"
        rows.append({**row, "ticks": part.ticks})
    return Table.of(rows)


def _heading(group: ActionGroup | None) -> str:
    """The name of a group with its unit, or of the overall error."""
    return with_unit(OVERALL, _STD) if group is None else with_unit(group.name, group.unit)


def still_dimensions(comparison: Comparison) -> str:
    """The dimensions that hardly move, and the overall error without them; empty without any."""
    still = comparison.low_variance()
    if not still:
        return ""
    largest = max(still, key=lambda index: comparison.scale[index] / still[index])
    rivals = rivalry(comparison.without_low_variance())
    return (
        f"hardly moving: {named(comparison.names, list(still))} (training std at most "
        f"{comparison.scale[largest]:.2g}, where {still[largest]:.2g} is usual for such "
        f"dimensions), {len(still)} of the {len(comparison.varying())} dimensions in the overall "
        f"error; without, that of the chunk is {rivals.policy.value:.3f}, "
        f"{rivals.ratio or np.nan:.2f} times the best baseline's ({HEADINGS[rivals.best]})"
    )


def verdicts(comparison: Comparison) -> str:
    """Whether policy and best baseline differ overall, in each scope."""
    if not _has_intervals(comparison):
        return f"{NO_INTERVAL}: five folds test each recording once (docs/training.md)"
    words: list[str] = []
    for scope, part in scopes(comparison).items():
        rivals = rivalry(part)
        verdict = rivals.verdict if rivals.verdict[:3] == "not" else f"resolved {rivals.verdict}"
        apart = f"{rivals.difference.text('+')} ({HEADINGS[rivals.best]})"
        words.append(f"{scope.replace('_', ' ')} {apart}: {verdict}")
    return f"policy minus best baseline [{_STD}]: {'; '.join(words)}"


def samples_text(comparison: Comparison, energy: Figure | None) -> str:
    """A line on the errors of one and of several samples."""
    sampled = sample_figures(comparison, energy)
    if not sampled:
        return "the expert gives one chunk a tick: nothing to say of several samples"
    figures = ", ".join(f"{name} {figure.text()}" for name, figure in sampled.items())
    return f"samples, whole chunk [{_STD}]: {figures}"


def error_text(comparison: Comparison, energy: Figure | None = None) -> str:
    """Tables of the executed steps and of the chunk; below them samples, verdicts and phases."""
    lines: list[str] = []
    for title, part in zip(titles(comparison), (comparison.executed, comparison), strict=True):
        lines += [f"{title}:", *error_table(part).text(), ""]
    lines += [FOOTNOTE, samples_text(comparison, energy), verdicts(comparison)]
    lines += [still] if (still := still_dimensions(comparison)) else []
    if by_phase(comparison):
        lines += ["", f"by phase, overall [{_STD}]:", *phase_table(comparison).text(), PHASE_RULE]
    return "\n".join(lines)


def ablation_table(study: AblationStudy) -> Table:
    """A row for each way to ablate a stream, between intact and the best baseline.

    It has the errors of each group and overall, and the overall error in multiples of intact with
    its interval.
    """
    best, intact = best_baseline(study.intact), study.intact.overall("policy")
    groups = study.intact.varying_groups()
    rows: list[list[Any]] = []

    def add(words: tuple[str, str], times: object, comparison: Comparison, method: str) -> None:
        errors = (comparison.error(method, group) for group in (*groups, None))
        rows.append([*words, times, *errors])

    add(("all", "intact"), "1" if intact > 0 else None, study.intact, "policy")
    for way in study.ablated:
        times = study.times_intact(way)
        add((way.stream, way.how), times and times.text(), way.comparison, "policy")
    blind = f"{study.intact.overall(best) / intact:.2f}" if intact > 0 else None
    add(("none", HEADINGS[best]), blind, study.intact, best)
    names = map(_heading, (*groups, None))
    heads = ["stream", "policy sees it", "times intact", *names]
    return Table(heads, rows, caption=ABLATION_FOOTNOTE, strong=frozenset({0}))


def ablation_text(study: AblationStudy) -> str:
    """`ablation_table` as lines, with its footnote and the study's notes below."""
    lines = [f"{evaluated_on(study)}:", *ablation_table(study).text()]
    return "\n".join([*lines, ABLATION_FOOTNOTE, *study.notes])


def evaluated_on(study: AblationStudy) -> str:
    """The title of the study's table."""
    return (
        f"mean absolute error on {study.intact.ticks} test ticks, {study.samples} chunk(s) a "
        "tick, one stream ablated each"
    )


def write_tables(folder: Path, evaluation: Evaluation) -> list[Path]:
    """Write metrics.json, its headline and the CSV files of all errors; see docs/reports.md.

    Without a `study`, streams.csv has only headings: `dvc plots` needs the file, and that of an
    earlier evaluation must not stay.
    """
    comparison, store, study = evaluation.comparison, evaluation.store, evaluation.study
    files = {
        "executed.csv": _group_errors(comparison.executed),
        "errors.csv": _group_errors(comparison),
        GROUPS: _recording_groups(comparison),
        "dimensions.csv": _dimensions(comparison),
        "steps.csv": _steps(comparison),
        "episodes.csv": _episodes(comparison, store),
        "predictions.csv": _predictions(comparison, evaluation.predictions, store),
        "streams.csv": _streams(study),
    }
    figures = metrics(comparison, evaluation.energy)
    documents = {"metrics.json": figures, "headline.json": headline(figures)}
    for name, document in documents.items():
        write_document(folder / name, document)
    tables = [table.write_csv(folder / name) for name, table in files.items()]
    return [*(folder / name for name in documents), *tables]


def _errors(comparison: Comparison, group: ActionGroup | None = None) -> dict[str, Any]:
    """The columns of all methods for a group, or overall."""
    return {
        head: value
        for method in METHODS
        for head, value in error(comparison, method, group).columns(method).items()
    }


def _named(group: ActionGroup | None) -> dict[str, Any]:
    name, unit = (OVERALL, _STD) if group is None else (group.name, group.unit)
    return {"group": name, "unit": unit}


def _group_errors(comparison: Comparison) -> Table:
    groups = (*comparison.groups, None)
    return Table.of(_named(group) | _errors(comparison, group) for group in groups)


def _recording_groups(comparison: Comparison) -> Table:
    """The overall error by group of test recordings; `stages.compare` pairs them."""
    columns: dict[str, NDArray[Any]] = {"group": np.unique(comparison.cells.group)}
    spans = {"executed": comparison.executed, OVERALL: comparison}
    for span, part in spans.items():
        columns[f"{span}_entries"] = by_group(part, part.cells.entries.sum(axis=1)).astype(np.int64)
    for span, part in spans.items():
        for method in METHODS:
            sums, entries = sums_by_group(part, method)
            columns[f"{method}_{span}"] = sums / entries
    return Table([*columns], list(zip(*(c.tolist() for c in columns.values()), strict=True)))


def _dimensions(comparison: Comparison) -> Table:
    """The errors of each dimension over the whole chunk."""
    return Table.of(
        {"dimension": name, "unit": unit} | _errors(comparison, ActionGroup(name, unit, (index,)))
        for index, (name, unit) in enumerate(zip(comparison.names, comparison.units, strict=True))
    )


def _steps(comparison: Comparison) -> Table:
    """The overall error [training std] by steps ahead."""
    return Table.of(
        {"steps_ahead": step} | _errors(comparison.part(steps=slice(step, step + 1)))
        for step in range(comparison.cells.entries.shape[1])
    )


def _episodes(comparison: Comparison, store: FeatureStore) -> Table:
    rows = [
        [
            *(store.episodes[index].source, store.episodes[index].id, group.name, group.unit),
            *(group.mean(comparison.scores[method].mae_episode[place]) for method in METHODS),
        ]
        for place, index in enumerate(comparison.episodes)
        for group in comparison.groups
    ]
    return Table(["source", "episode", "group", "unit", *METHODS], rows)


def _predictions(comparison: Comparison, predictions: Predictions, store: FeatureStore) -> Table:
    time_s = store.array("tick/time")[predictions.ticks]
    first = np.stack([predictions.recorded[:, 0], predictions.predicted[:, 0]], axis=-1)
    episodes = (store.episodes[index] for index in predictions.episodes)
    rows = [
        [episode.source, episode.id, f"{time:.3f}", *values.flat]
        for episode, time, values in zip(episodes, time_s, first, strict=True)
    ]
    columns = (f"{name}_{what}" for name in comparison.names for what in ("recorded", "predicted"))
    return Table(["source", "episode", "time_s", *columns], rows)


def _streams(study: AblationStudy | None) -> Table:
    """The overall error by way to ablate a stream, and in multiples of intact."""
    rows: list[list[Any]] = []
    if study is not None:
        for way in study.ablated:
            times = study.times_intact(way) or Figure(np.nan)
            own = error(way.comparison, "policy")
            rows.append([f"{way.stream} {way.how}", *astuple(times), *astuple(own)])
    heads = (Figure(np.nan).columns(name) for name in ("times_intact", "overall_error"))
    return Table(["spoilt", *chain(*heads)], rows)
