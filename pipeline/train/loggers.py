"""Who shows a run's curves while it goes: each is handed the same rows.

TensorBoard's and Weights & Biases' files carry the clock, and dvclive's report is never twice the
same, so they lie beside the logs, which DVC hashes, not in them.
"""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.base.ownership import REPORT, claim
from pipeline.train.live_page import LivePage

FINISH_TIMEOUT_S = 120.0
"""How long a finished run waits for Weights & Biases to take what it has not sent yet."""


_MODULES = {"tensorboard": "torch.utils.tensorboard", "wandb": "wandb.sdk"}
"""What is imported of a logger's package: a folder `wandb`, as that leaves where it runs, has none
of it."""


class Logger(Protocol):
    """Takes the rows of a run, in the order of their steps."""

    @property
    def note(self) -> str:
        """Where to look, as a line for the user."""
        ...

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a point, at a step counted from 1, to each of these curves."""
        ...

    def close(self, finished: bool) -> None:
        """End: the run is finished, or was stopped and may go on."""
        ...


class TensorBoard:
    """Event files in `folder`, of which the newest holds the whole run.

    The rows of before a stop are handed in again (`TrainingLog`), so each start tells TensorBoard
    to forget the files before it (`purge_step`): no step stands twice, nor any of a run before.
    They are not removed, for a TensorBoard that is looking at one would look there for ever.
    """

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.note = f"live: tensorboard --logdir {folder}"
        self._writer = SummaryWriter(str(folder), purge_step=0, flush_secs=10)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a scalar of each."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def close(self, finished: bool) -> None:
        """Write what is buffered."""
        self._writer.close()


class WandB:
    """A run of Weights & Biases, which goes on where this one was stopped.

    Its id lies in `<folder>/id` while a run of this folder may go on; rows that the service has are
    not sent again. `WANDB_MODE=offline` keeps everything in `folder`. Raises `ConfigError` where a
    run cannot begin; what cannot be sent later never stops a training.
    """

    def __init__(self, folder: Path, params: TrainHeadParams, resumed: bool) -> None:
        import wandb

        folder.mkdir(parents=True, exist_ok=True)
        identifier = _run_id(folder / "id", resumed)
        settings = wandb.Settings(
            console="off", silent=True, finish_timeout=FINISH_TIMEOUT_S, init_timeout=30
        )
        try:
            self._run: Any = wandb.init(
                project=params.wandb_project,
                dir=str(folder),
                id=identifier,
                name=params.output.name,
                resume="allow",
                config=params.model_dump(mode="json"),
                settings=settings,
            )
        except (wandb.Error, OSError, ValueError) as error:
            said = str(error).strip().rstrip(".")
            raise ConfigError(
                f"train_head.loggers has wandb, but no run can begin: {said}. Log in with "
                "`wandb login`, keep the run here with WANDB_MODE=offline (`wandb sync` sends it "
                "later), or take wandb out of train_head.loggers."
            ) from None
        self._from = self._run.starting_step
        if self._run.offline:
            self.note = f"wandb is offline; wandb sync {self._run.settings.sync_dir} sends the run"
        else:
            self.note = f"live: {self._run.url}"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Send a point of each, unless it is there from before a stop."""
        if step >= self._from:
            self._run.log(dict(metrics), step=step)

    def close(self, finished: bool) -> None:
        """Send the rest, for at most `FINISH_TIMEOUT_S`, and say where that fails."""
        import wandb

        try:
            self._run.finish(exit_code=0 if finished else 1)
        except (wandb.Error, OSError, RuntimeError) as error:
            print(f"wandb: not everything could be sent ({error}); `wandb sync` sends the rest")


def check_loggers(params: TrainHeadParams) -> None:
    """Raise `ConfigError` where a logger's package is not installed or does not load."""
    troubles = [f"{name} ({why})" for name in params.loggers if (why := _trouble(name))]
    if troubles:
        raise ConfigError(
            "train_head.loggers: expected the package of each logger, cannot load "
            f"{', '.join(troubles)}. "
            "Run pip install 'vla-feature-cache[loggers]', in a checkout "
            "pip install -e '.[loggers]', or set train_head.loggers=[report]."
        )


def open_loggers(params: TrainHeadParams, resumed: bool) -> list[Logger]:
    """The curves for DVC and the loggers of `params`. Raises `ConfigError`."""
    from pipeline.train.dvc_curves import DVCCurves  # and pandas: for a run that begins

    logs, chosen = params.logs, params.loggers
    claim(logs, REPORT)
    report = beside(logs, "dvclive.html") if "dvclive" in chosen else None
    found: list[Logger] = [DVCCurves(logs, report)]
    if "report" in chosen:
        title = f"{params.output}: {params.model_type}, {params.fusion_strategy}"
        found.append(LivePage(logs, title, params.max_steps))
    if "wandb" in chosen:
        found.append(WandB(beside(logs, "wandb"), params, resumed))
    if "tensorboard" in chosen:
        found.append(TensorBoard(beside(logs, "tensorboard")))
    return found


def beside(logs: Path, name: str) -> Path:
    """Where a logger keeps what DVC must not hash."""
    return logs.with_name(f"{logs.name}.{name}")


def _trouble(name: str) -> str:
    """Why a logger's package cannot be used; "" where it can."""
    if name not in _MODULES:
        return ""
    try:
        import_module(_MODULES[name])
    except ImportError as error:
        return str(error)
    return ""


def _run_id(path: Path, resumed: bool) -> str:
    """That of the run that goes on; a new one for a new run."""
    if resumed and path.exists():
        return path.read_text(encoding="ascii").strip()
    path.write_text(identifier := uuid4().hex[:16], encoding="ascii")
    return identifier
