"""Two extractions on one store: the second is told of the first; a dead one means nothing."""

import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pipeline.store import FeatureStore
from pipeline.store.lock import is_locked
from pipeline.store.writer import StoreBuild
from stages import extract
from stages.command import run


def extract_until_sealing(params: Path, told: Connection) -> None:
    """Extract, tell that all is there but the seal, and wait for the end."""

    def wait(self: StoreBuild, **how: Any) -> None:
        told.send("sealing")
        time.sleep(600)

    StoreBuild.seal = wait
    run("", extract.main, ["--params", str(params)])


def test_the_second_is_refused_and_a_killed_first_is_none(
    params, store, recordings, write_episode, fork, here
):
    write_episode(recordings / "Touch_dot" / "episode_4", 4)
    first, heard = fork(extract_until_sealing, params)
    try:
        heard.recv()
        code, _, complained = here("stages.extract", params)
        assert code == 2
        assert f"being built by process {first.pid} on" in complained
        assert is_locked(store)
    finally:
        first.kill()
        first.join()
    assert store.with_name("made.zarr.lock").read_text().startswith(f"process {first.pid}")
    assert not is_locked(store)
    code, said, complained = here("stages.extract", params)
    assert code == 0, complained
    assert "continuing the interrupted build" in said
    assert ", 0 computed" in said, "what the killed one committed is kept"
    assert len(FeatureStore.open(store).episodes) == 4
