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
COUNTED = """
import os, sys
from pipeline.vlm.qwen import FrozenVLM
real = FrozenVLM.encode
def encode(self, rows):
    with open(sys.argv[1], "a") as log:
        log.write(f"{len(rows)}\\n")
    return real(self, rows)
FrozenVLM.encode = encode
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


def killed_run(
    document: dict, folder: Path, kills: int, seed: int, duration: float
) -> tuple[Path, int]:
    """Start the stage and kill it `kills` times, then let it finish; (store, rows computed)."""
    chance = random.Random(seed)
    store = folder / "killed.zarr"
    params = folder / "killed.yaml"
    params.write_text(
        yaml.safe_dump({**document, "extract": {"store": str(store), "batch_size": BATCH}})
    )
    log = folder / "killed.log"
    for _ in range(kills):
        process = subprocess.Popen(
            command(log, params), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        time.sleep(chance.uniform(0.5, 1.0) * duration)
        process.send_signal(signal.SIGKILL)
        process.communicate()
    done = subprocess.run(command(log, params), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return store, sum(map(int, log.read_text().split())) if log.exists() else 0


@pytest.fixture
def undisturbed(document, tmp_path) -> tuple[FeatureStore, float]:
    """The store of a run that nobody kills, and how long it takes."""
    store = tmp_path / "undisturbed.zarr"
    params = tmp_path / "undisturbed.yaml"
    params.write_text(
        yaml.safe_dump({**document, "extract": {"store": str(store), "batch_size": BATCH}})
    )
    begun = time.monotonic()
    subprocess.run(command(tmp_path / "log", params), check=True, stdout=subprocess.DEVNULL)
    return FeatureStore.open(store), time.monotonic() - begun


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
    expected, duration = undisturbed
    store, computed = killed_run(document, tmp_path, kills, seed, duration)
    assert_equal_stores(FeatureStore.open(store), expected)
    rows = len(expected.array("vl/time"))
    assert rows <= computed <= rows + kills * BATCH
    assert sorted(path.name for path in tmp_path.glob("killed.zarr*")) == [
        "killed.zarr",
        "killed.zarr.files.sqlite",
        "killed.zarr.lock",
    ]


def test_sigterm_stops_cleanly_and_the_next_run_continues(document, undisturbed, tmp_path):
    expected, _ = undisturbed
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
    assert_equal_stores(FeatureStore.open(store), expected)
