"""A training is never silent for long, on a terminal or without one."""

import sys
from collections.abc import Callable
from io import StringIO
from typing import Any

import pytest

from pipeline.store import FeatureStore
from pipeline.train.progress import Progress

Make = Callable[..., Any]


class Terminal(StringIO):
    """What is written to it, which says that it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in s, which a test moves."""
    now = [1000.0]
    monkeypatch.setattr("pipeline.train.progress.time.monotonic", lambda: now[0])
    return now


def test_without_a_terminal_a_line_a_minute(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    def loss() -> float:
        asked.append(1)
        return 0.25

    with Progress(step=100, total=200, shown=True) as progress:
        for _ in range(30):  # steps of 5 s
            clock[0] += 5
            progress.advance(loss)
        progress.note(loss="0.25")
    out, err = capsys.readouterr()
    assert err.splitlines() == [
        "step 112 of 200: train loss 0.2500, 0.2 steps/s, about 7.3 min left",
        "step 124 of 200: train loss 0.2500, 0.2 steps/s, about 6.3 min left",
    ]
    assert (out, len(asked)) == ("", 2)


def test_of_several_processes_one_speaks(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with Progress(step=0, total=2, shown=False) as progress:
        clock[0] += 1e6
        progress.advance(lambda: 1.0)
    assert capsys.readouterr() == ("", "")


def test_between_evaluations_a_training_says_its_step_and_loss(
    store: FeatureStore,
    params: Make,
    trainer: Make,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("pipeline.train.progress.EVERY_S", 0.0)
    done = trainer(store, params(max_steps=3, eval_every=3))
    done.fit()
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"step {n} of 3" for n in (1, 2, 3)]
    losses = done.history.tensor()[:, done.history.columns.index("loss")].tolist()
    assert all(f"train loss {loss:.4f}" in line for loss, line in zip(losses, lines, strict=True))


def test_on_a_terminal_a_bar_with_the_loss(
    store: FeatureStore,
    params: Make,
    trainer: Make,
    clock: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr("pipeline.train.progress.EVERY_S", 0.0)
    trainer(store, params(max_steps=12, eval_every=12)).fit()
    shown = terminal.getvalue()
    assert "12/12" in shown
    assert "loss=" in shown.split("12/12")[0], "before the evaluation, too"
    assert "train loss" not in shown
