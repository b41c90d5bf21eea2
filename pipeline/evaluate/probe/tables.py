"""Findings -> what is printed and what is written."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.durable import write_document
from pipeline.evaluate.cells import aligned, cell, numbers, write_rows
from pipeline.evaluate.probe.ranking import gain_error, ranked, recommend
from pipeline.evaluate.probe.ridge import Score
from pipeline.evaluate.probe.run import Finding, Study

TOP = 12
"""Slots that are printed; the tables have all."""
_NAME = ("layer", "norm", "pooling", "view", "cell")
_FIGURES = (
    "valid_share",
    "r2_alone",
    "r2_alone_error",
    "r2_beside",
    "r2_beside_error",
    "r2_state_sensor",
    "gain",
    "gain_error",
    "penalty_alone",
    "penalty_beside",
)


def write_tables(folder: Path, study: Study) -> list[Path]:
    """Write metrics.json, slots.csv and groups.csv, the best first, and targets.csv.

    The last has R^2 by channel and step of the chunk, of the baseline and of each group.
    """
    write_document(folder / "metrics.json", metrics(study))
    return [
        folder / "metrics.json",
        write_rows(folder / "slots.csv", _rows(study.slots, ())),
        write_rows(folder / "groups.csv", _rows(study.groups, ("slots", "channels", "inputs"))),
        write_rows(folder / "targets.csv", _target_rows(study)),
    ]


def metrics(study: Study) -> dict[str, Any]:
    """The essential numbers: what was read, the baselines, each group, and the recommendation."""
    document: dict[str, Any] = {
        "ticks": len(study.folds.ticks),
        "recordings": study.folds.recordings,
        "folds": study.folds.count,
        "horizon": study.horizon,
        "mean_action": _score_document(study.mean_action),
    }
    if study.streams is not None:
        document["state_sensor"] = _score_document(study.streams)
    document["groups"] = {
        one.name.label: {
            "alone": _score_document(one.alone),
            "beside": _score_document(one.beside),
            "gain": numbers({"r2": one.gain, "error": gain_error(one)}),
        }
        for one in ranked(study.groups)
    }
    advice = recommend(study)
    if advice is not None:
        document["recommended"] = {
            "group": advice.chosen.name.label,
            "best": advice.best.name.label,
            "tied": [one.name.label for one in advice.tied],
            "reading": advice.reading,
        }
    return document


def table(study: Study) -> str:
    """The groups and the best slots, ranked, between the baselines."""
    beside = study.streams is not None
    lines = [["what is read", "inputs", "valid", "R2 alone", "+-"]]
    lines[0] += ["R2 beside", "+-", "gain", "+-"] if beside else []
    lines.append(_baseline("mean action", study.mean_action, 0, beside))
    if study.streams is not None:
        said = "state + sensor, without features"
        lines.append(_baseline(said, study.streams, study.stream_inputs, beside))
    lines += [_line(one, beside) for one in ranked(study.groups)]
    single = [one for one in ranked(study.slots) if one.name != one.name.group]
    lines += [_line(one, beside) for one in single[:TOP]]
    head = [
        f"R2 of the action chunk of {study.horizon} ticks on recordings that were held out, mean "
        "over channels and steps (1: exact, 0: no better than their mean)",
        f"{len(study.folds.ticks)} ticks of {study.folds.recordings} recordings in "
        f"{study.folds.count} folds; +-: standard error over folds",
    ]
    if beside:
        head.append(
            "beside: together with state + sensor; gain: what that adds to them. Choices are "
            "compared by their gains fold by fold, as some folds are harder for everyone"
        )
    wide = [one for one in study.groups if one.inputs < one.channels]
    notes = [
        f"{one.name.label}: its {one.channels} channels are read along {one.inputs} main "
        f"directions, {one.inputs // len(one.slots)} a slot, of the inputs of all folds"
        for one in wide
    ]
    if any(one.valid_share < 1 for one in [*study.groups, *study.slots]):
        notes.append(
            "slots valid at fewer ticks are scored on these alone: compare their gain, not R2"
        )
    if len(single) > TOP:
        notes.append(f"the other {len(single) - TOP} slots are in slots.csv")
    return "\n".join([*head, *aligned(lines), *study.folds.notes, *notes])


def advice(study: Study) -> str:
    """The lines of params.yaml that the evidence supports, and how sure it is."""
    if all(one.best is None for one in study.groups):
        return "no slot is valid in enough recordings to be scored: nothing to recommend"
    found = recommend(study)
    beside = study.streams is not None
    if found is None:
        over = "state + sensor, nor alone over the mean action" if beside else "the mean action"
        return (
            f"no recommendation: no choice gains over {over}, by more than one standard error and "
            "in most folds. So this store does not show that a linear reader gains from features; "
            "more recordings may."
        )
    lines = []
    if beside and found.reading == "alone":
        lines.append(
            "features alone predict better than the mean action; beside state + sensor no choice "
            "is better than both these and the mean action, by more than one standard error and in "
            "most folds. What follows rests on R2 alone."
        )
    if found.tied:
        labels = "; ".join(one.name.label for one in found.tied)
        lines.append(
            f"the best ({found.best.name.label}) is not ahead of these by more than one standard "
            f"error of their difference by fold, and in most folds: {labels}. Of all of them the "
            "one with the fewest slots is recommended."
        )
    elif len(study.groups) > 1:
        lines.append("no other choice is level with it, fold by fold, or keeps half of its gain")
    else:
        lines.append("the only choice in this store: extract more layers or poolings to compare")
    name = found.chosen.name
    lines.append(
        f"recommended for params.yaml: vlm: {{layers: [{name.layer}], "
        f"norms: [{json.dumps(name.norm)}], pooling: [{name.pooling}]}}"
    )
    if len(study.groups) > 1:
        lines.append(
            "to train on it alone: write that into params.yaml, run stages.extract into a store of "
            "its own (extract.store), then stages.train_head"
        )
    return "\n".join(lines)


def _rows(findings: Sequence[Finding], more: Sequence[str]) -> Iterable[Sequence[object]]:
    yield [*_NAME, *more, *_FIGURES]
    for one in ranked(findings):
        sizes = [len(one.slots), one.channels, one.inputs][: len(more)]
        yield [*_named(one), *sizes, *map(_cell, _figures(one))]


def _target_rows(study: Study) -> Iterable[Sequence[object]]:
    yield [*_NAME[:3], "step", "channel", "r2_alone", "r2_beside", "r2_state_sensor"]
    channels = len(study.action_names)
    for one in ranked(study.groups):
        scores = (one.alone, one.beside, one.without)
        for target in range(study.horizon * channels):
            step, channel = divmod(target, channels)
            r2 = [None if each is None else float(each.by_target[target]) for each in scores]
            place = [step + 1, study.action_names[channel]]
            yield [*_named(one)[:3], *place, *map(_cell, r2)]


def _figures(one: Finding) -> list[float | None]:
    """In the order of `_FIGURES`."""
    scores = [
        figure
        for score in (one.alone, one.beside)
        for figure in ((None, None) if score is None else (score.mean, score.error))
    ]
    without = None if one.without is None else one.without.mean
    return [
        one.valid_share,
        *scores,
        without,
        one.gain,
        gain_error(one),
        _penalty(one.alone),
        _penalty(one.beside),
    ]


def _named(one: Finding) -> list[object]:
    name = one.name
    place = "" if name.cell is None else f"{name.cell[0]},{name.cell[1]}"
    return [name.layer, json.dumps(name.norm), name.pooling, name.view or "", place]


def _penalty(score: Score | None) -> float | None:
    """The median over the folds."""
    return None if score is None else float(np.nanmedian(score.penalties))


def _cell(value: float | None) -> str:
    return "" if value is None else cell(value)


def _score_document(score: Score | None) -> dict[str, float]:
    return {} if score is None else numbers({"r2": score.mean, "error": score.error})


def _baseline(name: str, score: Score, inputs: int, beside: bool) -> list[str]:
    figures = [f"{score.mean:.3f}", f"{score.error:.3f}"]
    return [name, str(inputs), "", *figures, *([""] * 4 if beside else [])]


def _line(one: Finding, beside: bool) -> list[str]:
    figures = _figures(one)
    shown = [*figures[1:5], *figures[6:8]] if beside else figures[1:3]
    said = one.name.label + (f" ({len(one.slots)} slots)" if len(one.slots) > 1 else "")
    return [said, str(one.inputs), f"{one.valid_share:.0%}", *map(_short, shown)]


def _short(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.3f}"
