"""SIGKILL at random instants: the store that comes out at last equals an undisturbed one."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import yaml

from pipeline.store import FeatureStore, StoreBuild, part_path, read_plan
from pipeline.store.schema import ARRAY_NAMES, read_specs

BATCH = 2
IN_FLIGHT = 3
"""Batches that a kill may lose: one with the model or waiting to be handed in, one that waits for
the disk and one that is being written."""
COUNTED = """
import os, sys
from pipeline.vlm.qwen import FrozenVLM
real = FrozenVLM.submit
def submit(self, rows):
    with open(sys.argv[1], "a") as log:
        log.write(f"{len(rows)}\\n")
    return real(self, rows)
FrozenVLM.submit = submit
import pipeline.store.writer as writer
def slow_commit(self, *args, commit=writer.StoreBuild.commit):
    import time
    commit(self, *args)
    time.sleep(0.03)
writer.StoreBuild.commit = slow_commit
from stages.extract import main
from stages.command import run
raise SystemExit(run("", main, sys.argv[2:]))
"""
"""Runs the stage, noting every batch the model is given, slowly enough to be killed midway."""


def command(log: Path, params: Path) -> list[str]:
    return [sys.executable, "-c", COUNTED, str(log), "--params", str(params)]


@dataclass(frozen=True)
class Killed:
    """What a session had done when it was killed."""

    computed: int
    """Rows that the model was given."""
    marked: int
    """Rows that it brought into the build."""
    midway: bool
    """Whether the build was under way."""


def killed_runs(document: dict, folder: Path, kills: int, seed: int) -> tuple[Path, list[Killed]]:
    """Start the stage and kill it, `kills` times, then let it finish.

    Each kill comes a random while after the session's first sign of life: the build that it
    begins, or the first batch that it computes.
    """
    chance = random.Random(seed)
    store, log = folder / "killed.zarr", folder / "killed.log"
    params = folder / "killed.yaml"
    params.write_text(
        yaml.safe_dump({**document, "extract": {"store": str(store), "batch_size": BATCH}})
    )
    log.touch()
    sessions: list[Killed] = []
    for _ in range(kills):
        computed, marked = computed_of(log), marked_of(store)
        midway = killed_once(command(log, params), store, log, chance)
        session = Killed(computed_of(log) - computed, marked_of(store) - marked, midway)
        sessions.append(session)
    before = marked_of(store)
    computed = computed_of(log)
    done = subprocess.run(command(log, params), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = len(FeatureStore.open(store).array("vl/time"))
    assert computed_of(log) - computed == rows - before, "just what was missing is computed"
    return store, sessions


def killed_once(command: list[str], store: Path, log: Path, chance: random.Random) -> bool:
    """Whether the build was under way when the kill came."""
    part, begun = part_path(store), log.stat().st_size
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    sign = chance.choice(["build", "batch"])
    while process.poll() is None:
        if (sign == "build" and part.exists()) or log.stat().st_size > begun:
            break
        time.sleep(0.002)
    time.sleep(chance.uniform(0.0, 0.2))
    midway = part.exists() and process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return midway


def computed_of(log: Path) -> int:
    return sum(map(int, log.read_text().split()))


def marked_of(store: Path) -> int:
    """Rows of the build that count as done."""
    part = part_path(store)
    if store.exists():
        return len(FeatureStore.open(store).array("vl/time"))
    if not (part / "zarr.json").exists() or (plan := read_plan(part)) is None:
        return 0
    with closing(StoreBuild(store, read_specs(part), plan)) as build:
        return build.specs["vl/time"].shape[0] - len(build.missing())


@pytest.fixture(scope="module")
def document(make_document, tmp_path_factory) -> dict:
    """The same recordings for every test here: none changes them."""
    return make_document(tmp_path_factory.mktemp("killed"))


@pytest.fixture(scope="module")
def undisturbed(document, tmp_path_factory) -> FeatureStore:
    """The store of a run that nobody kills."""
    tmp_path = tmp_path_factory.mktemp("undisturbed")
    store = tmp_path / "undisturbed.zarr"
    params = tmp_path / "undisturbed.yaml"
    params.write_text(
        yaml.safe_dump({**document, "extract": {"store": str(store), "batch_size": BATCH}})
    )
    subprocess.run(command(tmp_path / "log", params), check=True, stdout=subprocess.DEVNULL)
    return FeatureStore.open(store)


def assert_equal_stores(found: FeatureStore, expected: FeatureStore) -> None:
    """Everything but the features exactly, those within the noise of float32."""
    for name in set(ARRAY_NAMES) - {"vl/features", "vl/checksum"}:
        assert np.array_equal(found.array(name), expected.array(name), equal_nan=True), name
    assert np.allclose(found.array("vl/features"), expected.array("vl/features"), atol=2e-5)
    for row, checksum in zip(found.array("vl/features"), found.array("vl/checksum"), strict=True):
        assert checksum == (google_crc32c.value(row.tobytes()) or 1)
    ours, theirs = dict(found.attrs), dict(expected.attrs)
    assert ours == theirs


@pytest.mark.parametrize(
    ("kills", "seed"),
    [(3, 0), *(pytest.param(6, seed, marks=pytest.mark.slow) for seed in range(1, 6))],
)
def test_random_kills_end_in_the_undisturbed_store(document, undisturbed, tmp_path, kills, seed):
    store, sessions = killed_runs(document, tmp_path, kills, seed)
    assert sum(one.midway for one in sessions) >= kills - 1, "the kills came too late"
    for one in sessions:
        assert 0 <= one.computed - one.marked <= IN_FLIGHT * BATCH, sessions
    assert any(one.marked for one in sessions), "no kill came after a commit"
    assert_equal_stores(FeatureStore.open(store), undisturbed)
    assert sorted(path.name for path in tmp_path.glob("killed.zarr*")) == [
        "killed.zarr",
        "killed.zarr.files.sqlite",
        "killed.zarr.lock",
    ]


def test_sigterm_stops_cleanly_and_the_next_run_continues(document, undisturbed, tmp_path):
    store, params, log = tmp_path / "stopped.zarr", tmp_path / "stopped.yaml", tmp_path / "log2"
    params.write_text(
        yaml.safe_dump({**document, "extract": {"store": str(store), "batch_size": BATCH}})
    )
    process = subprocess.Popen(
        command(log, params), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while not log.exists() and process.poll() is None:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGTERM)
    _, said = process.communicate()
    assert process.returncode == 1
    assert "Traceback" not in said
    assert "run the same command again" in said
    done = subprocess.run(command(log, params), capture_output=True, text=True, check=True)
    assert "continuing the interrupted build" in done.stdout
    assert_equal_stores(FeatureStore.open(store), undisturbed)
