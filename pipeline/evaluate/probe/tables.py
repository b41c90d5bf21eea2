"""The results of a probe as printed text, as `metrics.json` and as CSV files."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.files import write_document
from pipeline.base.text import Table
from pipeline.evaluate.probe.study import ProbeResult, ProbeStudy, depth, ranked, recommend
from pipeline.store import FeatureStore
from pipeline.store.proofs import Loss, Proof, slots_digest

TOP = 12
"""The most slots that are printed; the tables have all."""


def write_tables(folder: Path, study: ProbeStudy) -> list[Path]:
    """Write metrics.json, and slots.csv and groups.csv, the best first; return their paths."""
    of_groups = ("slots", "channels", "inputs", "row_bytes")
    slots = [_row(study, result) for result in ranked(study.slots)]
    tables = {
        "slots.csv": [{k: v for k, v in row.items() if k not in of_groups} for row in slots],
        "groups.csv": [_row(study, result) for result in ranked(study.groups)],
    }
    tables = {name: rows for name, rows in tables.items() if rows}  # slots may be too many
    write_document(folder / "metrics.json", metrics(study))
    files = (Table.of(rows).write_csv(folder / name) for name, rows in tables.items())
    return [folder / "metrics.json", *files]


def metrics(study: ProbeStudy) -> dict[str, Any]:
    """The content of metrics.json: ticks, baselines, each group, and the recommendation."""
    document: dict[str, Any] = {
        "ticks": len(study.folds.ticks),
        "recordings": study.folds.recordings,
        "folds": study.folds.count,
        "horizon": study.horizon,
        "repeats": len(study.folds.deals),
        "mean_action": study.mean_action.r2.document("r2"),
        "known": {known.name: known.score.r2.document("r2") for known in study.known},
        "groups": {
            result.name.label: {
                "alone": result.alone.r2.document("r2"),
                "beside": result.beside.r2.document("r2"),
                "gain": study.gain(result).document("r2"),
            }
            for result in ranked(study.groups)
        },
    }
    for result in study.codecs:
        document.setdefault("codecs", {}).setdefault(result.of.name.label, {})[result.codec] = {
            "row_bytes": result.row_bytes,
            "error_std": result.error,
            "difference": result.difference.document("r2"),
        }
    if study.seconds:
        document["pass_s"] = {str(layer): s for layer, s in study.seconds.items()}
    advised = recommend(study)
    if advised is not None:
        document["recommended"] = {
            "group": advised.chosen.name.label,
            "best": advised.best.name.label,
            "tied": [result.name.label for result in advised.tied],
            "reading": advised.reading,
        }
    return document


def ranking(study: ProbeStudy) -> Table:
    """The groups and the best slots, ranked, below the baselines."""
    baselines = [("mean action", 0, study.mean_action)]
    baselines += [(known.name, known.inputs, known.score) for known in study.known]
    rows: list[list[Any]] = [
        [name, inputs, None, None, score.r2.text("+"), None, None]
        for name, inputs, score in baselines
    ]
    single = [result for result in ranked(study.slots) if result.name != result.name.group]
    for result in [*ranked(study.groups), *single[:TOP]]:
        several = f" ({len(result.slots)} slots)" if len(result.slots) > 1 else ""
        size = f"{result.row_bytes:,}"
        rows.append([result.name.label + several, result.inputs, f"{result.valid_share:.0%}", size])
        figures = (result.alone.r2, result.beside.r2, study.gain(result))
        rows[-1] += [figure.text("+") for figure in figures]
        if study.seconds:
            rows[-1].append(f"{study.seconds[depth(result.name)]:.3g}")
    heads = ["what is read", "gain", "R2 beside", "R2 alone", "inputs", "valid", "bytes a row"]
    order = (0, 6, 5, 4, 1, 2, 3)
    if study.seconds:
        heads, order = [*heads, "s a pass"], (*order, 7)
        rows = [[*row, None][:8] for row in rows]
    return Table(heads, [[row[place] for place in order] for row in rows])


def codec_table(study: ProbeStudy) -> Table:
    """What each codec would lose of each group."""
    rows = [
        [
            result.codec,
            result.of.name.label,
            result.difference.text("+"),
            f"{result.error:.2g}",
            f"{result.row_bytes:,}",
        ]
        for result in study.codecs
    ]
    heads = ["extract.dtype", "what is read", "R2 minus stored", "error [std]", "bytes a row"]
    return Table(heads, rows)


def proofs(study: ProbeStudy, store: FeatureStore) -> dict[str, Proof]:
    """The verdict on each codec, for the file beside the store that was probed."""
    losses: dict[str, list[Loss]] = {}
    for result in study.codecs:
        figures = {"error_std": result.error, **result.difference.document("r2")}
        slots = slots_digest(store.attrs["slots"][slot] for slot in result.of.slots)
        of_group = {"of": result.of.name.group.label, "slots": slots}
        loss = Loss.model_validate({**of_group, **figures})
        losses.setdefault(result.codec, []).append(loss)
    recordings, ticks = study.folds.recordings, len(study.folds.ticks)
    return {
        codec: Proof(store=store.path.name, recordings=recordings, ticks=ticks, losses=own)
        for codec, own in losses.items()
    }


def notes(study: ProbeStudy) -> list[str]:
    """What a reader of the ranking has to know."""
    single = sum(result.name != result.name.group for result in study.slots)
    lines = [
        f"R2 of the action chunk of {study.horizon} ticks on recordings that were held out, mean "
        "over channels and steps (1: exact, 0: no better than their mean)",
        f"{len(study.folds.ticks)} ticks of {study.folds.recordings} recordings in "
        f"{study.folds.count} folds, dealt {len(study.folds.deals)} times",
        "in brackets 95 % intervals: recordings drawn anew, in each deal of the folds",
        f"beside: together with {study.baseline.name}; gain: what that adds to them",
        *study.folds.notes,
        "inputs fewer than channels are their main directions over all folds",
        "valid: the share of ticks that have a slot; elsewhere its mean is read",
    ]
    if study.seconds:
        lines.append("s a pass: of the model on one row, up to that layer, frames prepared before")
    if not study.slots:
        lines.append("single slots are too many to be scored one by one")
    if single > TOP:
        lines.append(f"the other {single - TOP} slots are in slots.csv")
    return lines


def table(study: ProbeStudy) -> str:
    """The ranking and its notes, for a terminal."""
    codecs = codec_table(study).text() if study.codecs else ()
    return "\n".join([*ranking(study).text(), *notes(study), *codecs])


def advice(study: ProbeStudy) -> str:
    """The lines of params.yaml that the results support, and how clearly."""
    advised = recommend(study)
    if advised is None:
        return (
            f"no recommendation: no choice gains over {study.baseline.name}, nor alone over the "
            "mean action, with an interval above 0. So this store does not show that a linear "
            "reader gains from features; more recordings may."
        )
    lines = []
    if advised.reading == "alone":
        lines.append(
            "features alone predict better than the mean action, but none gains beside "
            f"{study.baseline.name}: what follows rests on R2 alone."
        )
    if advised.tied:
        lines.append(
            f"the best ({advised.best.name.label}) is ahead of these by a difference that is not "
            f"resolved: {'; '.join(tied.name.label for tied in advised.tied)}. Of all of them the "
            "one with the fewest slots is recommended."
        )
    name = advised.chosen.name
    kind, _, sides = name.pooling.partition(" ")
    pooling = f"{{{kind}: [{sides.replace('x', ', ')}]}}" if sides else name.pooling
    norms = "" if name.layer == "vision" else f"norms: [{json.dumps(name.norm)}], "
    lines.append(
        f"recommended for params.yaml: vlm: {{layers: [{name.layer}], {norms}pooling: [{pooling}]}}"
    )
    return "\n".join(lines)


def _row(study: ProbeStudy, result: ProbeResult) -> dict[str, Any]:
    """A line of groups.csv."""
    name = result.name
    row: dict[str, Any] = {
        "layer": name.layer,
        "norm": json.dumps(name.norm),
        "pooling": name.pooling,
        "view": name.view,
        "cell": None if name.cell is None else f"{name.cell[0]},{name.cell[1]}",
        "slots": len(result.slots),
        "channels": result.channels,
        "inputs": result.inputs,
        "row_bytes": result.row_bytes,
        "valid_share": result.valid_share,
    }
    scores = {"alone": result.alone, "beside": result.beside}
    for reading, score in scores.items():
        row |= score.r2.columns(f"r2_{reading}")
    row["r2_known"] = study.baseline.score.mean
    row |= study.gain(result).columns("gain")
    for reading, score in scores.items():
        row[f"penalty_{reading}"] = float(np.median(score.penalties))
    return row
