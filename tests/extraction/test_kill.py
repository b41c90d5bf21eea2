"""SIGKILL at random instants: the store that comes out at last equals an undisturbed one."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import yaml

from pipeline.store import FeatureStore
from pipeline.store.schema import ARRAY_NAMES

BATCH = 4
IN_FLIGHT = 4
"""Batches that a kill may lose: one with the model, one handed in, one that waits for the disk and
one that is being written."""
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


def killed_run(document: dict, folder: Path, kills: int, seed: int) -> tuple[Path, int, int]:
    """Start the stage and kill it, `kills` times, then let it finish.

    Each kill comes a random while after the session's first sign of life: the build that it
    begins, or the first batch that it computes. Returns the store, the rows computed and how many
    kills hit a build that was under way.
    """
    chance = random.Random(seed)
    store, log = folder / "killed.zarr", folder / "killed.log"
    part = store.with_name("killed.zarr.part")
    params = folder / "killed.yaml"
    params.write_text(
        yaml.safe_dump({**document, "extract": {"store": str(store), "batch_size": BATCH}})
    )
    hits = 0
    for _ in range(kills):
        begun = log.stat().st_size if log.exists() else 0
        process = subprocess.Popen(
            command(log, params), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        signs = chance.choice(["build", "batch"])
        while process.poll() is None:
            if signs == "build" and part.exists():
                break
            if log.exists() and log.stat().st_size > begun:
                break
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.05))
        hits += part.exists() and process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.communicate()
    done = subprocess.run(command(log, params), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return store, sum(map(int, log.read_text().split())), hits


@pytest.fixture
def undisturbed(document, tmp_path) -> FeatureStore:
    """The store of a run that nobody kills."""
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
    [(5, 0), *(pytest.param(6, seed, marks=pytest.mark.slow) for seed in range(1, 6))],
)
def test_random_kills_end_in_the_undisturbed_store(document, undisturbed, tmp_path, kills, seed):
    store, computed, hits = killed_run(document, tmp_path, kills, seed)
    assert hits >= kills - 1, "the kills came too late to test anything"
    assert_equal_stores(FeatureStore.open(store), undisturbed)
    rows = len(undisturbed.array("vl/time"))
    assert rows <= computed <= rows + kills * IN_FLIGHT * BATCH
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
    assert "continues from here" in said
    done = subprocess.run(command(log, params), capture_output=True, text=True, check=True)
    assert "continuing the interrupted build" in done.stdout
    assert_equal_stores(FeatureStore.open(store), undisturbed)
