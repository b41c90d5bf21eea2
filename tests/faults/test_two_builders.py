"""Two extractions on one store: the second is told of the first; a dead one means nothing."""

import signal
from pathlib import Path

from pipeline.store import FeatureStore
from pipeline.store.inventory import list_stores

SLOWED = """
import sys, time
from pipeline.store import writer
from stages import extract
from stages.command import run

seal = writer.StoreBuild.seal
def slow(self, **how):
    print("sealing", flush=True)
    time.sleep(600)
writer.StoreBuild.seal = slow
sys.exit(run("", extract.main, sys.argv[1:]))
"""


def test_the_second_is_refused_and_a_killed_first_is_none(
    params: Path, store: Path, recordings: Path, write_episode, start, here
) -> None:
    write_episode(recordings / "Touch_dot" / "episode_4", 4)
    first = start(SLOWED, params)
    try:
        assert first.stdout is not None
        while line := first.stdout.readline():
            if line == "sealing\n":
                break
        assert first.poll() is None, "the first must still be at work"
        code, _, complained = here("stages.extract", params)
        assert code == 2
        assert f"being built by process {first.pid} on" in complained
        assert "run the same command again" in complained
        assert {entry.base for entry in list_stores(store.parent) if entry.holder} == {store}
    finally:
        first.send_signal(signal.SIGKILL)
        first.communicate()
    assert store.with_name("made.zarr.lock").read_text().startswith(f"process {first.pid}")
    assert not [entry for entry in list_stores(store.parent) if entry.holder]
    code, said, complained = here("stages.extract", params)
    assert code == 0, complained
    assert "continuing the interrupted build" in said
    assert ", 0 computed" in said, "what the killed one committed is kept"
    assert len(FeatureStore.open(store).episodes) == 4
