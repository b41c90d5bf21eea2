"""What a run writes down while it goes: curves for DVC, speed beside them."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from dvclive import Live

from pipeline.durable import disk_full_named, fresh
from pipeline.evaluation.experiments import speed_file
from pipeline.training.speed import Pace

Row = tuple[int, Mapping[str, float]]
"""A step, counted from 1, and metrics by name."""


class _Curves(Live):
    """dvclive's files without its repository.

    On start dvclive looks for git and DVC around the working directory: it fails in a repository
    without a commit and runs `dvc init` in one that does not use DVC. All of that serves
    experiments (`save_dvc_exp`), which DVC itself makes here, from the outputs in dvc.yaml.
    """

    def _init_dvc(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._dvc_file = "dvc.yaml"


class TrainingLog:
    """Curves in `<folder>/plots/metrics/*.tsv`, their newest values in `<folder>/metrics.json`.

    What came before a stop is given back as `earlier` and written again: DVC may have deleted the
    folder since, and a run that was killed has logged steps beyond its last checkpoint. Speed and
    memory since the last start go to `speed_file`, so that the folder, which DVC tracks, holds
    nothing of the clock. Raises `DiskFull`.
    """

    def __init__(self, folder: Path, earlier: Iterable[Row] = ()) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self.rows: list[Row] = []
        self._live = _Curves(str(folder), resume=False, dvcyaml=None, save_dvc_exp=False)
        self._speed = fresh(speed_file(folder)).open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._speed, delimiter="\t")
        self._writer.writerow(
            ["step", "steps_per_s", "data_wait_share", "peak_memory_mib", "trained_s"]
        )
        for step, metrics in earlier:
            self.write(step, metrics)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a point to each of these curves."""
        self.rows.append((step, dict(metrics)))
        with disk_full_named(self._folder):
            self._live.step = step
            for name, value in metrics.items():
                self._live.log_metric(name, value)
            self._live.make_summary()

    def write_speed(self, step: int, pace: Pace) -> None:
        """Add a line to `speed_file`."""
        with disk_full_named(self._folder):
            self._writer.writerow(
                [
                    step,
                    f"{pace.steps_per_s:.3f}",
                    f"{pace.data_wait_share:.4f}",
                    f"{pace.peak_memory / 2**20:.0f}",
                    f"{pace.trained_s:.3f}",
                ]
            )
            self._speed.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._speed.close()
        self._live.end()
