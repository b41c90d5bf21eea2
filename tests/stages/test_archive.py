"""`stages.archive` as a user meets it."""

import filecmp
from pathlib import Path

import pytest
import yaml

from stages.archive import SHORTHANDS, main
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def call(tmp_path, tiny_store):
    """`call(*arguments)` runs the stage on a small store, whose path is `call.store`."""
    store = tiny_store(tmp_path)
    params = tmp_path / "params.yaml"
    document = yaml.safe_load((ROOT / "params.yaml").read_text())
    document["extract"]["store"] = str(store)
    params.write_text(yaml.safe_dump(document))

    def called(*arguments: str) -> int:
        return run("", main, ["--params", str(params), *arguments], shorthands=SHORTHANDS)

    called.store = store
    return called


def test_archive_and_restore_beside_the_store(call, tmp_path, capsys):
    assert call() == 0
    (line,) = capsys.readouterr().out.splitlines()
    output = tmp_path / "tiny.archive.zarr"
    assert line.startswith(f"{output}: ") and ": 1)" in line
    assert call() == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.endswith("nothing to do")
    kept = call.store.rename(tmp_path / "kept.zarr")
    assert call("--restore") == 0
    assert f"as archived in {output}" in capsys.readouterr().out
    files = [p.relative_to(kept).as_posix() for p in kept.rglob("*") if p.is_file()]
    assert filecmp.cmpfiles(kept, call.store, files, shallow=False) == (files, [], [])
    assert call("--restore") == 0


def refused(call, capsys, *overrides: str) -> str:
    options = [part for override in overrides for part in ("--set", override)]
    assert call(*options) == 2
    return capsys.readouterr().err


def test_a_place_that_no_archive_can_have(call, capsys, tmp_path):
    assert "not an archive of" in refused(call, capsys, f"archive.output={call.store}")
    output = f"archive.output={tmp_path / 'kept'}"
    assert f"Set {output}.zarr" in refused(call, capsys, output)
