"""The curves that a training logged, read back."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.border import Border
from pipeline.base.errors import ConfigError
from pipeline.policy.checkpoint import PolicyCheckpoint

_CURVES = Border(ConfigError, "Train again where curves are wanted.")


@dataclass(frozen=True)
class TrainingCurve:
    """One metric over the steps of a training, both (point,)."""

    step: NDArray[np.int64]
    value: NDArray[np.float64]


@dataclass(frozen=True)
class TrainingCurves:
    """The curves that a training logged, or why there are none."""

    curves: Mapping[str, TrainingCurve]
    """By name: `train/loss`, `val/error`, `lr`, …"""
    absence: str = ""
    """If there are none, one sentence that names the path."""


def read_curves(checkpoint: PolicyCheckpoint) -> TrainingCurves:
    """The curves of a checkpoint's training, where its logs still have them."""
    folder = checkpoint.params.logs / "plots" / "metrics"
    files = sorted(folder.rglob("*.tsv"))
    try:
        read = {file.relative_to(folder).with_suffix("").as_posix(): _read(file) for file in files}
    except ValueError as error:
        absence = f"No training curves: those in {folder} cannot be read ({error})."
        return TrainingCurves({}, absence)
    curves = {name: curve for name, curve in read.items() if len(curve.step)}
    if not curves:
        return TrainingCurves({}, f"No training curves: there are none in {folder} any more.")
    if _of_another(curves, checkpoint):
        return TrainingCurves({}, f"No training curves: those in {folder} are of another training.")
    return TrainingCurves(curves)


def _of_another(curves: Mapping[str, TrainingCurve], checkpoint: PolicyCheckpoint) -> bool:
    """Whether another training wrote the logs: they lack the checkpoint's step or its error."""
    if max(int(curve.step[-1]) for curve in curves.values()) < checkpoint.step:
        return True
    error, curve = checkpoint.metrics.get("val/error"), curves.get("val/error")
    if error is None or curve is None:
        return False
    return not np.isclose(curve.value[curve.step == checkpoint.step], error, rtol=1e-4).any()


def _read(file: Path) -> TrainingCurve:
    """The columns `step` and value below a line of heads; `ValueError` on anything else."""
    lines = _CURVES.read_bytes(file).decode().splitlines()
    _, *rows = (line.split("\t") for line in lines)
    steps = np.array([int(step) for step, _ in rows], np.int64)
    return TrainingCurve(steps, np.array([float(value) for _, value in rows], np.float64))
