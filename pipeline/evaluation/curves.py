"""What a training wrote down of its course, read back."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Curve:
    """One metric over the steps of a training, both (point,)."""

    step: NDArray[np.int64]
    value: NDArray[np.float64]


@dataclass(frozen=True)
class Curves:
    """All that a training logged, or why there is nothing of it."""

    curves: Mapping[str, Curve]
    """By name: `train/loss`, `val/error`, `lr`, …"""
    absence: str = ""
    """One sentence where there are none, naming the path."""


def read_curves(logs: Path) -> Curves:
    """The curves that a training with these `train_head.logs` left there."""
    folder = logs / "plots" / "metrics"
    files = sorted(folder.rglob("*.tsv"))
    if not files:
        return Curves({}, f"No training curves: there are none in {folder} any more.")
    try:
        found = {file.relative_to(folder).with_suffix("").as_posix(): _read(file) for file in files}
    except (ValueError, KeyError) as error:
        return Curves({}, f"No training curves: those in {folder} cannot be read ({error}).")
    return Curves({name: curve for name, curve in found.items() if len(curve.step)})


def _read(file: Path) -> Curve:
    """The columns `step` and the file's own name; `ValueError` or `KeyError` on anything else."""
    rows = list(csv.DictReader(file.read_text(encoding="utf-8").splitlines(), delimiter="\t"))
    try:
        return Curve(
            np.array([int(row["step"]) for row in rows], np.int64),
            np.array([float(row[file.stem]) for row in rows], np.float64),
        )
    except TypeError:
        raise ValueError(f"a row of {file.name} is cut short") from None
