"""`stages.extract` as a user meets it: exit codes and messages."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
import zarr

from pipeline.store import FeatureStore
from pipeline.store.chunks import write_seal
from stages.command import run
from stages.extract import main
from tests.data.conftest import Truth, edit_json, write_raw
from tests.data.conftest import write_lerobot as write_small_lerobot

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def params_file(tmp_path: Path, demo_checkpoint: Path) -> Path:
    document = yaml.safe_load((ROOT / "params.yaml").read_text())
    document["data"] |= {"root": str(tmp_path), "sources": [{"name": "lab", "path": "day*/run"}]}
    document["vlm"]["checkpoint"] = str(demo_checkpoint)
    document["extract"]["store"] = str(tmp_path / "lab.zarr")
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def refused(capsys: pytest.CaptureFixture[str], params_file: Path, *overrides: str) -> str:
    """What stands on stderr after exit 2."""
    options = [part for override in overrides for part in ("--set", override)]
    assert run("", main, ["--params", str(params_file), *options]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    return err


def planned(capsys: pytest.CaptureFixture[str], params_file: Path, *overrides: str) -> str:
    """What a plan that goes well prints."""
    options = [part for override in overrides for part in ("--set", override)]
    told = ["--params", str(params_file), "--set", "extract.plan=true", *options]
    assert run("", main, told) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_an_empty_glob_and_an_unknown_codebase_version(capsys, params_file, tmp_path):
    err = refused(capsys, params_file)
    assert "'day*/run' matches nothing" in err
    assert str(tmp_path) in err
    meta = tmp_path / "day1/run/meta"
    meta.mkdir(parents=True)
    (meta / "info.json").write_text('{"codebase_version": "v9.0", "fps": 10, "features": {}}')
    assert "v9.0" in refused(capsys, params_file, "data.on_bad_episode=skip"), "no episode's fault"


def test_an_absolute_path_is_watched_where_it_is_in_the_root(capsys, params_file, tmp_path):
    source = write_raw(tmp_path / "lab/run", Truth())
    sources = f"data.sources=[{{name: lab, path: {source}}}]"
    assert "DVC" not in planned(capsys, params_file, sources)
    other = tmp_path / "other"
    other.mkdir()
    said = planned(capsys, params_file, sources, f"data.root={other}")
    assert f"{source} is outside data.root ({other}), so DVC does not watch it" in said


def test_a_trimmed_copy_is_read_without_the_episodes_before_and_behind(
    capsys, params_file, tmp_path
):
    root = write_small_lerobot(tmp_path / "day1/run", "v3.0")
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.ParquetFile(path).read().slice(1, 1), path)
    planned(capsys, params_file)


def test_two_rates_in_one_store(capsys, params_file, tmp_path):
    write_small_lerobot(tmp_path / "day1/run")
    times = (np.arange(7) / 20).astype(np.float32)
    fast = write_small_lerobot(tmp_path / "day2/run", lengths=(7,), timestamp=times)
    edit_json(fast / "meta/info.json", fps=20)
    sources = [{"name": day, "path": f"{tmp_path}/{day}/*"} for day in ("day1", "day2")]
    options = (f"data.sources={json.dumps(sources)}", "extract.plan=true")
    err = refused(capsys, params_file, "data.action_hz=null", *options)
    assert re.search(r"10 Hz in source 'day1' \(.*day1.*20 Hz in source 'day2' \(.*day2", err)


def test_a_store_of_recorded_rows_says_their_rate(capsys, params_file, tmp_path):
    """And so does one that an earlier version wrote, which did not; no row is computed again."""
    info = write_small_lerobot(tmp_path / "day1/run") / "meta/info.json"
    store = tmp_path / "lab.zarr"
    options = ["--params", str(params_file), "--set", "data.action_hz=null"]
    assert run("", main, options) == 0, capsys.readouterr().err
    assert json.loads(info.read_text())["fps"] == FeatureStore.open(store).action_hz == 10
    group = zarr.open_group(store, mode="r+")
    group.attrs.update(action_hz=None, plan="0" * 64)
    write_seal(store)
    assert run("", main, options) == 0, capsys.readouterr().err
    told = capsys.readouterr().out
    assert "why: extract.sensor_dtype, action_hz, the order of episodes" in told
    assert ", 0 to compute" in told
    assert FeatureStore.open(store).action_hz == 10


def test_recordings_without_any_frame(capsys, params_file, tmp_path):
    info = write_small_lerobot(tmp_path / "day1/run") / "meta/info.json"
    features = json.loads(info.read_text())["features"]
    blind = {name: feature for name, feature in features.items() if "images" not in name}
    edit_json(info, features=blind)
    assert "WARNING: none of the 3 episode(s) has a frame" in planned(capsys, params_file)
    assert "has a frame" not in planned(capsys, params_file, "data.views=[]")


def test_the_first_ten_of_many_bad_episodes_are_listed(capsys, params_file, tmp_path):
    for number in range(13):
        (tmp_path / f"day1/run/{number}").mkdir(parents=True)
        (tmp_path / f"day1/run/{number}/metadata.json").write_text("[]")
    lengths = (7,) * 14
    root = write_small_lerobot(tmp_path / "day2/run", lengths=lengths, tasks=["pick"] * 14)
    for path in (root / "data/chunk-000").glob("episode_0000[01][1-9].parquet"):
        path.unlink(missing_ok=True)
    err = refused(capsys, params_file, "extract.plan=true")
    assert "\n  lab: " in err and err.count("metadata.json: ") == 10
    assert "\nand 3 more episodes\nMend or remove them" in err
    out = planned(capsys, params_file, "data.on_bad_episode=skip")
    assert out.count("\nskipped lab: ") == 10
    assert "\nand 3 more skipped episodes" in out
    assert out.count("not there: lab: ") == 10
    assert "\nand 2 more episodes that are not there" in out


def test_what_to_set_instead_is_named(capsys, params_file, tmp_path):
    write_small_lerobot(tmp_path / "day1/run", lengths=(7,))
    for option, mend in (
        ("vlm.layers=[99]", "Set vlm.layers to some of these"),
        ("data.views=[View9]", "Set data.views to some of these, or to null for all"),
        ("extract.device=xyz", "Set device to auto or cpu, or install what python -m stages.doc"),
        (f"vlm.checkpoint={params_file}", "no such folder.*Set vlm.checkpoint to one"),
        (f"vlm.checkpoint={tmp_path / 'nowhere'}", f"{tmp_path}/nowhere"),
    ):
        assert re.search(mend, refused(capsys, params_file, option, "extract.plan=true"))
