"""What a run logs: the loss at every step, its curves and its speed.

Every logger takes the same rows. DVC hashes the folder of logs, so the files of TensorBoard and
Weights & Biases, which hold clock times, lie beside it.
"""

import json
import math
import os
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

import torch
from jaxtyping import Float64
from torch import Tensor

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.base.files import (
    REPORT,
    claim,
    disk_full_named,
    fresh,
)

FINISH_TIMEOUT_S = 120.0
"""How long a finished run waits until Weights & Biases has sent its remaining rows."""
_MODULES = {"tensorboard": "torch.utils.tensorboard", "wandb": "wandb.sdk"}
"""The module whose import shows that a logger's package is installed. `import wandb` would not show
it: it also takes a folder `wandb` that a run left behind."""

Row = tuple[int, Mapping[str, float]]
"""A step, counted from 1, and metrics by name."""


class History:
    """A row of named scalars for each step.

    Rows stay on the device until `settle`: reading them at every step would make the CPU wait for
    the GPU.
    """

    def __init__(
        self, columns: Sequence[str] = (), rows: Float64[Tensor, "step column"] | None = None
    ) -> None:
        self.columns = tuple(columns)
        self._settled = torch.empty((0, 0), dtype=torch.float64) if rows is None else rows
        self._pending: list[Mapping[str, Tensor]] = []

    def add(self, values: Mapping[str, Tensor]) -> None:
        """Add the scalars of the next step; every step has the same names."""
        self.columns = self.columns or tuple(values)
        self._pending.append(values)

    def settle(self) -> int | None:
        """Fetch the pending rows; returns the first step with a NaN or inf, or None."""
        if not self._pending:
            return None
        first = len(self._settled)
        scalars = [values[name].float() for values in self._pending for name in self.columns]
        rows = torch.stack(scalars).view(-1, len(self.columns)).to("cpu", torch.float64)
        self._pending.clear()
        self._settled = torch.cat([self._settled.view(-1, len(self.columns)), rows])
        bad = ~torch.isfinite(rows).all(dim=1)
        return first + int(bad.nonzero()[0, 0]) if bad.any() else None

    def tensor(self) -> Float64[Tensor, "step column"]:
        """All settled rows."""
        return self._settled

    def mean(self, first: int, stop: int) -> dict[str, float]:
        """The mean of each column over the settled steps [first, stop)."""
        means = self._settled[first:stop].mean(dim=0).tolist()
        return dict(zip(self.columns, means, strict=True))

    def last(self, name: str) -> float:
        """A column at the newest settled step."""
        return float(self._settled[-1, self.columns.index(name)])

    def describe(self, step: int) -> str:
        """A step's row as text."""
        row = zip(self.columns, self._settled[step].tolist(), strict=True)
        return ", ".join(f"{name} {value:g}" for name, value in row)


class Logger(Protocol):
    """Takes the rows of a run, in the order of their steps."""

    note: str
    """A line for the user: where to look."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a point, at a step counted from 1, to each of these curves."""

    def close(self, finished: bool) -> None:
        """End the log; if not `finished`, the run was stopped and may be resumed."""


class CurveFiles:
    """Curves as DVC plots them: `plots/metrics/<name>.tsv`, the newest values in `metrics.json`.

    The files have dvclive's format. dvclive itself fails in a repository without a commit and runs
    `dvc init` in one that does not use DVC.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._plots = folder, folder / "plots" / "metrics"
        self.note = f"live: dvc plots show {self._plots}"
        for path in self._plots.rglob("*.tsv"):
            path.unlink()
        fresh(folder / "metrics.json")
        self._newest: dict[str, Any] = {}

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a line to each file."""
        for name, value in metrics.items():
            path = self._plots / f"{name}.tsv"
            *groups, column = name.split("/")
            begun = path.exists()
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="utf-8") as file:
                file.write("" if begun else f"step\t{column}\n")
                file.write(f"{step}\t{value}\n")
            entry = self._newest
            for group in groups:
                entry = entry.setdefault(group, {})
            entry[column] = value if math.isfinite(value) else str(value)
        self._newest["step"] = step
        text = json.dumps(self._newest, indent=4)
        (self._folder / "metrics.json").write_text(f"{text}\n", encoding="utf-8")

    def close(self, finished: bool) -> None:
        """Does nothing: `write` writes every row at once."""


class TensorBoard:
    """TensorBoard's event files in `folder`; the newest file holds the whole run.

    `TrainingLog` writes the earlier rows again after a stop, so each start tells TensorBoard to
    forget the older files (`purge_step`): no step appears twice. Those files are not deleted,
    because a running TensorBoard would wait for ever for a deleted file.
    """

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.note = f"live: tensorboard --logdir {folder}"
        self._writer = SummaryWriter(str(folder), purge_step=0, flush_secs=10)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a scalar for each metric."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def close(self, finished: bool) -> None:
        """Write the buffered points."""
        self._writer.close()


class WandB:
    """A run of Weights & Biases, which resumes when the training does.

    `<folder>/id` holds its id; rows that the service has are not sent again. With
    `WANDB_MODE=offline` everything stays in `folder`. Raises `ConfigError` where a run cannot
    begin; a failure to send never stops a training.
    """

    def __init__(self, folder: Path, params: TrainHeadParams, resumed: bool) -> None:
        import wandb

        folder.mkdir(parents=True, exist_ok=True)
        settings = wandb.Settings(
            console="off", silent=True, finish_timeout=FINISH_TIMEOUT_S, init_timeout=30
        )
        try:
            self._run: Any = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "vla-feature-cache"),
                dir=str(folder),
                id=_run_id(folder / "id", resumed),
                name=params.output.name,
                resume="allow",
                config=params.model_dump(mode="json"),
                settings=settings,
            )
        except (wandb.Error, OSError, ValueError) as error:
            why = str(error).strip().rstrip(".")
            raise ConfigError(
                f"train_head.loggers has wandb, but no run can begin: {why}. Log in with "
                "`wandb login`, keep the run here with WANDB_MODE=offline (`wandb sync` sends it "
                "later), or take wandb out of train_head.loggers."
            ) from None
        self._from = self._run.starting_step
        if self._run.offline:  # the `url` of an offline run prints a warning
            self.note = f"wandb is offline; wandb sync {self._run.settings.sync_dir} sends the run"
        else:
            self.note = f"live: {self._run.url}"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Send a point of each curve, unless the service received it before a stop."""
        if step >= self._from:
            self._run.log(dict(metrics), step=step)

    def close(self, finished: bool) -> None:
        """Send the rest within `FINISH_TIMEOUT_S`; prints a line where that fails."""
        import wandb

        try:
            self._run.finish(exit_code=0 if finished else 1)
        except (wandb.Error, OSError, RuntimeError) as error:
            print(f"wandb: not everything could be sent ({error}); `wandb sync` sends the rest")


def _run_id(path: Path, resumed: bool) -> str:
    """The id in this file for a resumed run; a new one for a new run."""
    if resumed and path.exists():
        return path.read_text(encoding="ascii").strip()
    path.write_text(identifier := uuid4().hex[:16], encoding="ascii")
    return identifier


def check_loggers(params: TrainHeadParams) -> None:
    """Raise `ConfigError` where a logger's package is not installed or does not load."""
    for name in params.loggers:
        try:
            import_module(_MODULES[name])
        except ImportError as error:
            raise ConfigError(
                f"train_head.loggers: cannot load the package of {name} ({error}). Run pip install "
                "'vla-feature-cache[loggers]', in a checkout pip install -e '.[loggers]', or set "
                "train_head.loggers=[]."
            ) from None


def open_loggers(params: TrainHeadParams, resumed: bool) -> list[Logger]:
    """The curves for DVC and the loggers of `params`. Raises `ConfigError`."""
    claim(params.logs, REPORT)
    loggers: list[Logger] = [CurveFiles(params.logs)]
    if "wandb" in params.loggers:
        loggers.append(WandB(_beside(params.logs, "wandb"), params, resumed))
    if "tensorboard" in params.loggers:
        loggers.append(TensorBoard(_beside(params.logs, "tensorboard")))
    return loggers


def _beside(logs: Path, name: str) -> Path:
    """A path beside the logs, for files with clock times: DVC hashes the logs."""
    return logs.with_name(f"{logs.name}.{name}")


class TrainingLog(AbstractContextManager["TrainingLog"]):
    """Writes the same rows to every logger, and keeps them.

    The rows from before a stop, `earlier`, are written again: DVC may have deleted the folder since
    then, and a killed run has logged steps beyond its last checkpoint. Raises `DiskFull`.
    """

    def __init__(
        self, folder: Path, loggers: Sequence[Logger], earlier: Iterable[Row] = ()
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._loggers = folder, loggers
        self.rows: list[Row] = []
        for step, metrics in earlier:
            self.write(step, metrics)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a point to each of these curves, in every logger."""
        self.rows.append((step, dict(metrics)))
        with disk_full_named(self._folder):
            for logger in self._loggers:
                logger.write(step, metrics)

    def __exit__(self, kind: type[BaseException] | None, *raised: object) -> None:
        with disk_full_named(self._folder), ExitStack() as closing:
            # Where a logger fails, the others are closed too.
            for logger in reversed(self._loggers):
                closing.callback(logger.close, kind is None)


@contextmanager
def open_log(
    params: TrainHeadParams, resumed: bool, earlier: Iterable[Row]
) -> Generator[TrainingLog]:
    """The log with the loggers of `params`; prints where to look.

    Raises `ConfigError` or `DiskFull`.
    """
    with disk_full_named(params.logs):
        loggers = open_loggers(params, resumed)
    with TrainingLog(params.logs, loggers, earlier) as log:
        print(*(logger.note for logger in loggers), sep="\n")
        yield log
