"""A clock that goes backwards in a recording added later: the old store stays as it is."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.store import FeatureStore
from stages import extract, train_head
from stages.command import run


@pytest.fixture
def backwards(recordings: Path, write_episode: Callable[..., Path]) -> Path:
    """The file of a new recording whose seventh stretch of readings comes before the sixth."""
    episode = write_episode(recordings / "Touch_dot" / "episode_4", 4)
    file = episode / "sensor_data.npz"
    with np.load(file) as loaded:
        arrays = dict(loaded)
    arrays["timestamps"][6] -= 0.35
    np.savez(file, **arrays)
    return file


def content(store: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}


def test_it_is_refused_and_the_store_untouched(
    backwards: Path, store: Path, params: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = content(store)
    assert run("", extract.main, ["--params", str(params)]) == 2
    said = capsys.readouterr().err
    assert "1 of 4 episodes cannot be used" in said
    assert str(backwards) in said
    assert "backwards" in said
    assert "on_bad_episode=skip" in said
    assert content(store) == before
    assert not store.with_name("made.zarr.part").exists()
    assert (
        run("", train_head.main, ["--params", str(params), "--set", "train_head.max_steps=2"]) == 0
    )


def test_skipped_it_changes_nothing(
    backwards: Path, store: Path, params: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = content(store)
    skip = ["--params", str(params), "--set", "data.on_bad_episode=skip"]
    assert run("", extract.main, skip) == 0
    said = capsys.readouterr().out
    assert str(backwards) in said
    assert "up to date, nothing to do" in said
    assert content(store) == before
    assert len(FeatureStore.open(store).episodes) == 3
