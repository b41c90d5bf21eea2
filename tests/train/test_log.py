"""The loggers: the same rows to each, a stop that leaves no step twice, and what is missing."""

import errno
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError, DiskFull
from pipeline.base.files import MARKER
from pipeline.train import log as loggers
from pipeline.train.log import TrainingLog, check_loggers


class Full:
    """A logger on a disk that is full."""

    def __init__(self) -> None:
        self.closed: list[bool] = []

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def close(self, finished: bool) -> None:
        self.closed.append(finished)


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard reads in a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [(one.step, one.value) for one in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }


def curves(logs: Path) -> dict[str, list[tuple[int, float]]]:
    root = logs / "plots" / "metrics"
    found: dict[str, list[tuple[int, float]]] = {}
    for file in root.rglob("*.tsv"):
        lines = [line.split("\t") for line in file.read_text().splitlines()[1:]]
        name = file.relative_to(root).with_suffix("").as_posix()
        found[name] = [(int(step), float(value)) for step, value in lines]
    return found


@pytest.mark.extra
def test_every_logger_has_the_curves_of_dvc_after_a_stop_too(
    store, params, trainer, stop_at, monkeypatch, capsys
):
    """The stop comes at step 17, the last checkpoint is of step 15: 16 and 17 come again."""
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    monkeypatch.setattr("pipeline.train.loop.LOG_EVERY", 1)
    chosen = params(loggers=["tensorboard"])
    events = chosen.logs.with_name("logs.tensorboard")
    stop_at(trainer(store, chosen), 17)
    assert f"live: tensorboard --logdir {events}" in capsys.readouterr().out
    assert scalars(events)["train/loss"][-1][0] == 17
    resumed = trainer(store, chosen)
    assert (resumed.run.status, resumed.step) == ("resumed", 15)
    resumed.fit()
    expected = curves(chosen.logs)
    assert [step for step, _ in expected["train/loss"]] == list(range(1, 21))
    found = scalars(events)
    assert found.keys() == expected.keys()
    for name, points in expected.items():
        assert [step for step, _ in found[name]] == [step for step, _ in points], name
        assert [v for _, v in found[name]] == pytest.approx([v for _, v in points], rel=1e-6)


def test_a_missing_package_and_one_that_does_not_load_are_named(tmp_path, params, monkeypatch):
    """What is left of wandb is the folder it makes where it runs; tensorboard is half installed."""
    for name in [
        name for name in sys.modules if name.partition(".")[0] in ("wandb", "tensorboard")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
    (tmp_path / "wandb").mkdir()
    (tmp_path / "tensorboard").mkdir()
    (tmp_path / "tensorboard" / "__init__.py").write_text("raise ImportError('no protobuf')")
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    chosen = params(loggers=["tensorboard", "wandb"])
    with pytest.raises(ConfigError, match=r"tensorboard \(no protobuf\)"):
        check_loggers(chosen)
    check_loggers(params(loggers=[]))


def test_curves_are_those_that_dvc_plots(tmp_path, params):
    chosen = params(max_steps=20)
    for last in (30, 20):
        opened = loggers.open_loggers(chosen, resumed=False)
        with TrainingLog(chosen.logs, opened) as log:
            for step in range(10, last + 10, 10):
                log.write(step, {"train/loss": 1 / step, "lr": float("nan")})
    assert opened[0].note == f"live: dvc plots show {chosen.logs}/plots/metrics"
    assert {path.name for path in chosen.logs.iterdir()} == {MARKER, "plots", "metrics.json"}
    metrics = chosen.logs / "plots" / "metrics"
    # As dvclive writes them.
    assert (metrics / "train" / "loss.tsv").read_text() == "step\tloss\n10\t0.1\n20\t0.05\n"
    assert (metrics / "lr.tsv").read_text() == "step\tlr\n10\tnan\n20\tnan\n"
    newest = json.loads((chosen.logs / "metrics.json").read_text())
    assert newest == {"train": {"loss": 0.05}, "lr": "nan", "step": 20}


def test_a_full_disk_is_named_and_every_logger_is_closed(tmp_path):
    first, second = Full(), Full()
    with pytest.raises(DiskFull), TrainingLog(tmp_path, [first, second]) as log:
        log.write(10, {"train/loss": 1.0})
    assert first.closed == second.closed == [False]


class Service:
    """Stands for wandb: a run of which the service has rows up to `starting_step`."""

    class Error(Exception):
        pass

    def __init__(self, starting_step: int) -> None:
        self.starting_step = starting_step
        self.offline, self.url = False, "https://service/run"
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.given: dict[str, Any] = {}

    def Settings(self, **given: Any) -> dict[str, Any]:  # noqa: N802
        return given

    def init(self, **given: Any) -> "Service":
        self.given = given
        return self

    def log(self, metrics: dict[str, float], step: int) -> None:
        self.logged.append((step, metrics))

    def finish(self, exit_code: int) -> None:
        raise self.Error("the service is gone")


def test_rows_that_the_service_has_are_not_sent_again_and_its_loss_stops_nothing(
    tmp_path, monkeypatch, capsys
):
    service = Service(starting_step=21)
    monkeypatch.setenv("WANDB_PROJECT", "needles")
    monkeypatch.setitem(sys.modules, "wandb", service)
    identifiers = []
    for resumed in (False, False, True):  # a new run has an id of its own
        run = loggers.WandB(tmp_path, TrainHeadParams(), resumed)
        identifiers.append(service.given["id"])
    assert identifiers[0] != identifiers[1] == identifiers[2]
    assert (service.given["project"], service.given["resume"]) == ("needles", "allow")
    for step in (10, 20, 30):
        run.write(step, {"train/loss": 1.0})
    assert service.logged == [(30, {"train/loss": 1.0})]
    run.close(finished=True)
    assert "not everything could be sent (the service is gone)" in capsys.readouterr().out
