"""A store that cannot be written to: everything that only reads works."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def read_only(store: Path, tmp_path: Path) -> Iterator[Path]:
    """The store on a file system that is mounted read-only: root may write past a file's mode."""
    place = tmp_path / "read_only"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(place)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("a file system cannot be mounted here (needs root)")
    try:
        shutil.copytree(store, place / store.name)
        subprocess.run(["mount", "-o", "remount,ro", str(place)], check=True, capture_output=True)
        yield place / store.name
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def test_stage_two_and_every_check_work(read_only, params, here, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.look.page.writing.write_report", lambda *_: [])
    options = ["--set", f"extract.store={read_only}"]
    for name, *more in (
        ("stages.train_head", "--set", "train_head.max_steps=4"),
        ("stages.evaluate", "--set", "evaluate.modalities=false"),
        ("stages.verify",),
        ("stages.archive", "--set", f"archive.output={tmp_path / 'copy.archive.zarr'}"),
        ("stages.store", "list", "--set", f"stores.folder={read_only.parent}"),
    ):
        code, said, complained = here(name, params, *more, *options)
        assert code == 0, (name, complained)
    assert read_only.name in said


def test_an_extraction_into_it_says_what_is_wrong_and_where(read_only, params, here):
    options = ["--set", f"extract.store={read_only}"]
    code, _, complained = here("stages.extract", params, *options, "--set", "data.views=[View1]")
    assert code == 2
    assert str(read_only) in complained
    assert "Read-only file system" in complained
    assert "run the same" in complained
