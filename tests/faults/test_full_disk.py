"""A disk that fills up: exit 2, a message that names the place, and the next run completes."""

import re
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from io import StringIO
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from pipeline.store import FeatureStore
from stages.command import run


def run_unchecked(name: str, params: Path, options: Sequence[str], told: Connection) -> None:
    """Run a stage that finds room for all it plans, as where another program fills the disk."""
    import_module("pipeline.extract.streams").free_bytes = lambda path: 2**40
    stage = import_module(name)
    arguments = ["--params", str(params), *options]
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as complained:
        code = run("", stage.main, arguments, getattr(stage, "SHORTHANDS", ()))
    told.send((code, complained.getvalue()))


def fill(disk: Path, leave: int) -> Path:
    """Write a file that leaves so many bytes free."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(2**12))
        except OSError:
            pass
    size = ballast.stat().st_size
    with ballast.open("r+b") as file:
        file.truncate(max(0, size - leave))
    return ballast


@pytest.fixture
def full_then_free(fork, here, small_disk: Path) -> Callable[..., None]:
    """`full_then_free(leave, name, params, *options)`: on a disk with no more room, then with it.

    The first run is a process of its own: a SIGBUS would end this one.
    """

    def check(leave: int, name: str, params: Path, *options: str) -> None:
        ballast = fill(small_disk, leave)
        process, heard = fork(run_unchecked, name, params, options)
        code, complained = heard.recv()  # nothing comes of one that ends by a signal or traceback
        process.join()
        assert code == 2, complained
        assert complained.startswith("error: ")
        assert str(small_disk) in complained
        assert re.search("no space left|disk is full", complained, re.IGNORECASE)
        assert "run the same" in complained
        ballast.unlink()
        code, _, complained = here(name, params, *options)
        assert code == 0, complained

    return check


@pytest.mark.parametrize("leave", [pytest.param(50_000, marks=pytest.mark.slow), 1_500_000])
def test_extract(document, small_disk: Path, full_then_free, params: Path, leave: int) -> None:
    target = small_disk / "made.zarr"
    options = ["--set", f"extract.store={target}", "--set", "extract.sensor_dtype=float16"]
    full_then_free(leave, "stages.extract", params, *options)
    assert FeatureStore.open(target).ticks == 68


def test_train_and_evaluate(
    tiny_store, head_params, small_disk, full_then_free, tmp_path, monkeypatch
):
    # Of this process, which has room: most of the time goes into pictures.
    monkeypatch.setattr("pipeline.look.page.writing.write_report", lambda *_: [])
    store = tiny_store(tmp_path)
    output, report = small_disk / "head", small_disk / "report"
    params = head_params(
        store,
        train_head={"output": str(output), "max_steps": 8},
        evaluate={"checkpoint": str(output), "output": str(report), "modalities": False},
    )
    full_then_free(20_000, "stages.train_head", params)
    assert (output / "best" / "policy.json").exists()
    full_then_free(5_000, "stages.evaluate", params)
    assert (report / "metrics.json").exists()
