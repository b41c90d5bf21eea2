"""`stages.store` as a user meets it."""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.store import FeatureStore
from pipeline.train.run import find_trained
from stages import store as stage
from stages import train_head
from stages.command import run


@pytest.fixture
def params(tiny_head: Callable[..., dict[str, Any]], tmp_path: Path) -> Path:
    (tmp_path / "stores").mkdir()
    small = tiny_head(tmp_path, output=str(tmp_path / "models" / "head"), horizon=2, max_steps=2)
    document = {
        "data": {"sources": [{"name": "left", "path": "a"}, {"name": "right", "path": "b"}]},
        "vlm": {"checkpoint": "unused"},
        "extract": {"store": str(tmp_path / "stores" / "one.zarr")},
        "train_head": small,
        "stores": {
            "folder": str(tmp_path / "stores"),
            "checkpoints": [str(tmp_path / "models")],
        },
    }
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def command(params: Path, *arguments: str) -> int:
    return run("", stage.main, ["--params", str(params), *arguments], stage.SHORTHANDS)


def test_list_names_what_was_trained_on_a_store(params, tiny_store, tmp_path, capsys):
    stores = tmp_path / "stores"
    tiny_store(stores, name="one")
    tiny_store(stores, name="two", seed=1)
    assert run("", train_head.main, ["--params", str(params)]) == 0
    best = tmp_path / "models" / "head" / "best"
    subprocess.run(["cp", "-r", best, tmp_path / "models" / "lone"], check=True)
    (tmp_path / "models" / "broken").mkdir()
    (tmp_path / "models" / "broken" / "policy.json").write_text("{")
    capsys.readouterr()
    assert command(params, "list") == 0
    said = capsys.readouterr()
    lines = said.out.splitlines()
    first, second = (
        next(i for i, x in enumerate(lines) if x.startswith(n)) for n in ("one", "two")
    )
    of_first = "\n".join(lines[first:second])
    of_second = "\n".join(lines[second:])
    assert f"{tmp_path}/models/head: can be evaluated on it" in of_first
    assert f"{tmp_path}/models/lone: can be evaluated on it" in of_first
    assert "models" not in of_second
    lone = next(p for p in find_trained([tmp_path / "models"]) if p.folder.name == "lone")
    store = FeatureStore.open(stores / "one.zarr")
    fewer = tiny_store(tmp_path / "fewer", name="one", episodes=5)
    assert lone.fits(store)
    assert not lone.fits(FeatureStore.open(fewer))
    assert "spec tiny-spe: 3 slots x 8 in float32" in said.out
    assert "prompt {instruction}" in said.out
    assert "broken/policy.json" in said.err


def test_merge_gives_a_store_that_trains(params, tiny_store, tmp_path, capsys):
    a, b = (str(tiny_store(tmp_path, name=name, seed=seed)) for seed, name in enumerate("ab"))
    into = tmp_path / "stores" / "one.zarr"
    assert command(params, "merge", a, b, "--into", str(into)) == 0
    said = capsys.readouterr().out
    assert f"{into}: 12 episodes, 120 rows, none computed" in said
    assert run("", train_head.main, ["--params", str(params)]) == 0
    assert "12 episodes, 360 ticks" in capsys.readouterr().out
    assert command(params, "merge", a, b, "--into", str(into)) == 0
    assert "up to date, nothing to do" in capsys.readouterr().out


def test_mistakes_end_in_one_message(params, tiny_store, tmp_path, capsys):
    a = str(tiny_store(tmp_path, name="a"))
    other = str(tiny_store(tmp_path, name="b", reuse=2))
    into = ["--into", str(tmp_path / "c.zarr")]
    for arguments, said in (
        (["merge", a, other], "stores.output"),
        (["merge", a, other, *into], "vlm_reuse_count: 3 -> 2"),
        (["tidy"], "stores.action"),
        (["list", a], "list takes no paths"),
        (["gc", a, "--remove"], "expected an unfinished build"),
        (["list", "--set", f"stores.folder={tmp_path / 'nowhere'}"], "stores.folder"),
    ):
        assert command(params, *arguments) == 2
        err = capsys.readouterr().err
        assert err.startswith("error: ")
        assert said in err


def test_gc_lists_and_removes_only_when_told_to(params, tiny_store, tmp_path, capsys):
    stores = tmp_path / "stores"
    tiny_store(stores, name="one")
    tiny_store(stores, name="two").rename(stores / "two.zarr.part")
    (stores / "new.zarr.part").mkdir()
    assert command(params, "gc") == 0
    said = capsys.readouterr().out
    assert f"unneeded: {stores}/new.zarr.part" in said
    assert f"kept: {stores}/two.zarr.part: 60 feature rows; python -m stages.store gc" in said
    assert "--remove removes what is unneeded" in said
    assert len(os.listdir(stores)) == 3
    assert command(params, "gc", "--remove") == 0
    assert f"removed: {stores}/new.zarr.part" in capsys.readouterr().out
    assert not (stores / "new.zarr.part").exists()
    elsewhere = ["--set", f"stores.folder={tmp_path / 'nowhere'}"]
    assert command(params, "gc", str(stores / "two.zarr.part"), "--remove", *elsewhere) == 0
    assert f"removed: {stores}/two.zarr.part" in capsys.readouterr().out
    assert not (stores / "two.zarr.part").exists()
    assert command(params) == 0, "lists"
    captured = capsys.readouterr()
    assert "one.zarr" in captured.out and captured.err == "", "progress is silent"
    assert FeatureStore.open(stores / "one.zarr").ticks == 180
    assert command(params, "gc", "--remove") == 0
    assert "nothing to remove" in capsys.readouterr().out
