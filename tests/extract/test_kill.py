"""SIGKILL at random instants: the store that comes out at last equals an undisturbed one."""

import os
import random
import signal
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import google_crc32c
import pytest
import yaml

from pipeline.base.config import Params
from pipeline.extract import extract
from pipeline.extract.build_state import StorePlaces
from pipeline.store import FeatureStore, part_path
from tests.extract.conftest import assert_same, run

BATCH = 2
IN_FLIGHT = 3
"""Batches that a kill may lose: one with the model or waiting to be handed in, one that waits for
the disk and one that is being written."""
COUNTED = """
import sys, time
from pathlib import Path
from pipeline.store import StoreBuild
from pipeline.vlm.qwen import FrozenVLM
log, marked, batches = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
given = []
def submit(self, rows, submit=FrozenVLM.submit):
    if len(given) == batches:
        time.sleep(600)
    given.append(len(rows))
    with log.open("a") as noted:
        noted.write(f"{len(rows)}\\n")
    return submit(self, rows)
FrozenVLM.submit = submit
def slow_mark(self, *args, mark=StoreBuild.mark):
    mark(self, *args)
    marked.touch()
    time.sleep(0.03)
StoreBuild.mark = slow_mark
from stages.extract import main
from stages.command import run
raise SystemExit(run("", main, sys.argv[4:]))
"""
"""Runs the stage, noting every batch the model is given and that rows are marked; after so many
batches it waits to be stopped."""
BATCHES = 12
"""Of all rows."""


def document_of(document: dict, store: Path) -> dict:
    """The document of the same extraction into another store."""
    return {**document, "extract": {"store": str(store), "batch_size": BATCH}}


@dataclass(frozen=True)
class Killed:
    """What a session had done when it was killed."""

    computed: int
    """Rows that the model was given."""
    marked: int
    """Rows that it brought into the build."""
    midway: bool
    """Whether the build was under way."""


def killed_runs(
    begin: Callable, document: dict, folder: Path, kills: int, seed: int
) -> tuple[Path, list[Killed]]:
    """Start the stage and kill it, `kills` times, then let it finish.

    Each kill comes a random while after a sign of life of the session: the build that it begins or
    goes on with, the first batch that it computes, or (in the first session) that it marks.
    """
    chance = random.Random(seed)
    store, log = folder / "killed.zarr", folder / "killed.log"
    params = folder / "killed.yaml"
    params.write_text(yaml.safe_dump(document_of(document, store)))
    log.touch()
    sessions: list[Killed] = []
    for number in range(kills):
        computed, marked = computed_of(log), marked_of(store)
        mark, batches = folder / f"mark{number}", chance.randint(2, BATCHES // kills)
        signs = {
            "build": part_path(store).exists,
            "batch": partial(grown, log, log.stat().st_size),
            "mark": mark.exists,
        }
        sign = chance.choice(["build", "batch"]) if number else "mark"
        arguments = log, mark, batches, "--params", params
        process = begin(COUNTED, folder, *map(str, arguments))
        while process.poll() is None and not signs[sign]():
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.2))
        midway = process.poll() is None
        process.kill()
        sessions.append(Killed(computed_of(log) - computed, marked_of(store) - marked, midway))
    before = marked_of(store)
    report = extract(Params.model_validate(document_of(document, store)), lambda line: None)
    assert report.computed == report.rows - before, "just what was missing is computed"
    return store, sessions


def grown(log: Path, size: int) -> bool:
    return log.stat().st_size > size


def computed_of(log: Path) -> int:
    return sum(map(int, log.read_text().split()))


def marked_of(store: Path) -> int:
    """Rows of the build that count as done."""
    if store.exists():
        return len(FeatureStore.open(store).array("vl/time"))
    places = StorePlaces(store)
    if places.begun is None:
        return 0
    with closing(places.begun_build()) as build:
        return build.specs["vl/time"].shape[0] - len(build.missing())


@pytest.fixture(scope="module")
def document(make_document, tmp_path_factory) -> dict:
    """The same recordings for every test here: none changes them."""
    return make_document(tmp_path_factory.mktemp("killed"))


@pytest.fixture(scope="module")
def undisturbed(document, tmp_path_factory) -> FeatureStore:
    """The store of a run that nobody kills."""
    store = tmp_path_factory.mktemp("undisturbed") / "undisturbed.zarr"
    extract(Params.model_validate(document_of(document, store)), lambda line: None)
    return FeatureStore.open(store)


def assert_equal_stores(found: FeatureStore, expected: FeatureStore) -> None:
    assert_same(found, expected)
    for row, checksum in zip(found.array("vl/features"), found.array("vl/checksum"), strict=True):
        assert checksum == (google_crc32c.value(row.tobytes()) or 1)
    assert dict(found.attrs) == dict(expected.attrs)


@pytest.mark.parametrize(
    ("kills", "seed"),
    [(3, 0), *(pytest.param(6, seed, marks=pytest.mark.slow) for seed in range(1, 6))],
)
def test_random_kills_end_in_the_undisturbed_store(
    begin, document, undisturbed, tmp_path, kills, seed
):
    store, sessions = killed_runs(begin, document, tmp_path, kills, seed)
    assert sum(one.midway for one in sessions) >= kills - 1, "the kills came too late"
    for one in sessions:
        assert 0 <= one.computed - one.marked <= IN_FLIGHT * BATCH, sessions
    assert sessions[0].marked, "no kill came after a commit"
    assert_equal_stores(FeatureStore.open(store), undisturbed)
    assert sorted(path.name for path in tmp_path.glob("killed.zarr*")) == [
        "killed.zarr",
        "killed.zarr.files.sqlite",
        "killed.zarr.lock",
    ]


def test_sigterm_stops_cleanly_and_the_next_run_continues(begin, document, undisturbed, tmp_path):
    store, params, log = tmp_path / "stopped.zarr", tmp_path / "stopped.yaml", tmp_path / "log2"
    params.write_text(yaml.safe_dump(document_of(document, store)))
    mark = tmp_path / "mark"
    process = begin(COUNTED, tmp_path, str(log), str(mark), "2", "--params", str(params))
    while not log.exists() and process.poll() is None:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGTERM)
    assert process.wait() == 1
    assert process.stderr.read_text() == "stopped; run the same command again\n"
    _, said = run(Params.model_validate(document_of(document, store)))
    assert "continuing the interrupted build" in said[0]
    assert_equal_stores(FeatureStore.open(store), undisturbed)
