"""Room for the store, for DVC's copy, in memory and among maps; links and limits."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from pipeline.base.config import Params
from pipeline.data import open_recordings
from pipeline.look.doctor import space
from pipeline.look.doctor.data import check_data
from pipeline.look.doctor.limits import Limits, check_limits, read_limits
from pipeline.look.doctor.links import Cache, check_cache, check_links, links_here, read_cache
from pipeline.look.doctor.space import (
    Estimate,
    check_cached_copy,
    check_disk,
    check_maps,
    check_page_cache,
    check_space,
    estimate_store,
    used_bytes,
)
from stages import extract
from stages.command import run

GIB = 2**30
TEN = Estimate(bytes=10 * GIB, maps=160, episodes=50, read=8)
STORE = Path("cache_store/lab.zarr")
ROOM = Limits(cores=8, memory=64 * GIB, open_files=4096, shared=8 * GIB)


@pytest.mark.parametrize(
    ("free", "begun", "finished", "level"),
    [
        (11, 0, False, "ok"),
        (9, 0, False, "missing"),
        (9, 2, False, "ok"),
        (9, 0, True, "note"),
        (11, 0, True, "ok"),
    ],
)
def test_room_for_the_store(free: int, begun: int, finished: bool, level: str) -> None:
    finding = check_disk(TEN, STORE, free * GIB, begun * GIB, finished=finished)
    assert finding.level == level
    assert "about 10.0 GiB for 50 episodes, judged by 8 of them" in finding.found
    assert ("set extract.store to another disk" in finding.remedy) == (level != "ok")


def test_room_for_the_copy_that_dvc_keeps() -> None:
    assert check_cached_copy(TEN, 21 * GIB, 0, 0).level == "ok"
    tight = check_cached_copy(TEN, 15 * GIB, 0, 0)
    assert tight.level == "note" and tight.found.endswith("20.0 GiB with its copy")
    begun = check_cached_copy(TEN, 15 * GIB, 6 * GIB, 0)
    assert begun.level == "ok" and begun.found.endswith("6.0 GiB of it written")
    there = check_cached_copy(TEN, 11 * GIB, 0, 12 * GIB)
    assert there.level == "ok" and "10.0 GiB of it written, and the copy too if" in there.found
    assert check_cached_copy(TEN, 9 * GIB, 0, 12 * GIB).level == "note"


def test_memory_and_maps() -> None:
    assert check_page_cache(TEN, 16 * GIB).level == "ok"
    assert check_page_cache(TEN, 12 * GIB).level == "note"
    assert check_maps(TEN, 65530).level == "ok"
    many = check_maps(replace(TEN, maps=70_000), 65530)
    assert many.level == "missing"
    assert many.remedy == "sudo sysctl vm.max_map_count=280000"


def test_the_estimate_is_what_extraction_takes(
    tmp_path: Path, demo_checkpoint: Path, recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(space, "BUDGET_S", 200.0)  # every episode is read, however busy it is here
    document = {
        "data": {
            "root": str(recordings),
            "sources": [{"name": "raw", "path": "raw"}, {"name": "new", "path": "new"}],
        },
        "vlm": {
            "checkpoint": str(demo_checkpoint),
            "dtype": "float32",
            "image_resize_height": 28,
            "image_resize_width": 28,
        },
        "extract": {"store": str(tmp_path / "made.zarr"), "device": "cpu"},
    }
    params = Params.model_validate(document)
    before, bad = estimate_store(params)
    assert before is not None and before.read == before.episodes == 4 and not bad
    assert [finding.level for finding in check_space(params)][:1] == ["ok"]
    assert not list(tmp_path.glob("made*")), "a check writes nothing"
    file = tmp_path / "params.yaml"
    file.write_text(yaml.safe_dump(document))
    assert run("", extract.main, ["--params", str(file)]) == 0
    taken = used_bytes(tmp_path / "made.zarr")
    # Chunk files are whole pages, and metadata takes some.
    assert before.bytes < taken < 1.5 * before.bytes + 2**20
    files = [path for path in (tmp_path / "made.zarr").rglob("*") if path.is_file()]
    assert before.maps == sum(path.name != "zarr.json" for path in files)


def test_without_a_checkpoint_the_size_is_not_known() -> None:
    params = Params.model_validate(
        {"data": {"sources": [{"name": "a", "path": "."}]}, "vlm": {"checkpoint": "/no/such"}}
    )
    (finding,) = check_space(params)
    assert finding.level == "note" and "vlm.checkpoint" in finding.found


def test_without_recordings_the_size_is_not_known(tmp_path: Path, demo_checkpoint: Path) -> None:
    """The recordings' own group says why."""
    document = {
        "data": {"root": str(tmp_path), "sources": [{"name": "a", "path": "a"}]},
        "vlm": {"checkpoint": str(demo_checkpoint)},
    }
    (finding,) = check_space(Params.model_validate(document))
    assert finding.level == "note" and "before the recordings can be read" in finding.found


@pytest.mark.parametrize(("on_bad", "level"), [("stop", "missing"), ("skip", "note")])
def test_an_episode_that_cannot_be_used_is_said_and_the_others_give_the_size(
    tmp_path: Path,
    recordings: Path,
    demo_checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
    on_bad: str,
    level: str,
) -> None:
    """It opens, so that the recordings' own group finds nothing."""
    monkeypatch.setattr(space, "BUDGET_S", 200.0)
    shutil.copytree(recordings / "raw", tmp_path / "raw")
    states = sorted(tmp_path.glob("raw/**/robot_state_*.csv"))
    head, *rows = states[0].read_text().splitlines()
    rows[7] = ",".join([*rows[7].split(",")[:-1], "nan"])
    states[0].write_text("\n".join([head, *rows]))
    params = Params.model_validate(
        {
            "data": {
                "root": str(tmp_path),
                "sources": [{"name": "a", "path": "raw"}],
                "on_bad_episode": on_bad,
            },
            "vlm": {"checkpoint": str(demo_checkpoint)},
        }
    )
    assert {finding.level for finding in check_data(params)} == {"ok"}
    bad, disk, *_ = check_space(params)
    assert (bad.level, bad.subject) == (level, "episodes")
    assert "1 episode(s) read for the size cannot be used" in bad.found
    assert str(states[0]) in bad.found
    assert "data.on_bad_episode" in bad.remedy
    assert disk.level == "ok" and "for 1 episodes;" in disk.found


def test_params_that_the_checkpoint_cannot_meet_are_said(
    recordings: Path, demo_checkpoint: Path
) -> None:
    document = {
        "data": {"root": str(recordings), "sources": [{"name": "a", "path": "raw"}]},
        "vlm": {"checkpoint": str(demo_checkpoint), "layers": [99]},
    }
    (finding,) = check_space(Params.model_validate(document))
    assert finding.level == "missing" and "99" in finding.found


def test_where_every_episode_is_bad_the_size_is_not_known(
    tmp_path: Path, recordings: Path, demo_checkpoint: Path
) -> None:
    shutil.copytree(recordings / "raw", tmp_path / "raw")
    for stream in tmp_path.glob("raw/**/robot_state_*.csv"):
        stream.unlink()
    document = {
        "data": {
            "root": str(tmp_path),
            "sources": [{"name": "a", "path": "raw"}],
            "on_bad_episode": "skip",
        },
        "vlm": {"checkpoint": str(demo_checkpoint)},
    }
    params = Params.model_validate(document)
    opened = open_recordings(params.data.sources, params.data.root)
    assert opened.bad and not opened.recordings
    (finding,) = check_space(params)
    assert finding.level == "note"
    assert finding.found == "not known: no episode could be read; see above"


def cache(**changed: object) -> Cache:
    here = Cache(Path(".dvc/cache"), ("reflink", "hardlink", "copy"), ("hardlink", "copy"), True)
    return replace(here, **changed)  # type: ignore[arg-type]


def test_the_link_that_dvc_takes() -> None:
    (finding,) = check_cache(cache())
    assert finding.level == "ok" and "takes: hardlink" in finding.found
    (default,) = check_cache(cache(types=("reflink", "copy")))
    assert default.level == "note" and "on the disk twice" in default.found
    assert default.remedy.startswith("dvc config cache.type")
    (far,) = check_cache(cache(working=("copy",), same_disk=False))
    assert far.level == "note" and "another disk" in far.found
    assert far.remedy.startswith("dvc cache dir")
    (closed,) = check_cache(cache(working=()))
    assert closed.level == "note" and "nothing can be written there" in closed.found
    (none,) = check_cache(None)
    assert none.level == "note" and none.remedy == "dvc init"


def test_links_are_really_tried(tmp_path: Path) -> None:
    assert read_cache(tmp_path) is None
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / ".dvc").mkdir()
    (tmp_path / ".dvc" / "config").write_text('[cache]\n    type = "hardlink,copy"\n')
    (tmp_path / "below").mkdir()
    found = read_cache(tmp_path / "below")
    assert found is not None
    assert found.types == ("hardlink", "copy")
    assert {"hardlink", "symlink", "copy"} <= set(found.working)
    assert found.same_disk and found.link == "hardlink"
    left = [path for path in (tmp_path / ".dvc").rglob("*") if path.is_file()]
    assert [path.name for path in left] == ["config"], "what was tried is removed"


def test_a_config_that_dvc_cannot_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".dvc").mkdir()
    (tmp_path / ".dvc" / "config").write_text("garbage [[\n")
    monkeypatch.chdir(tmp_path)
    params = Params.model_validate(
        {"data": {"sources": [{"name": "a", "path": "."}]}, "vlm": {"checkpoint": "a/b"}}
    )
    (finding,) = check_links(params)
    assert finding.level == "missing" and "garbage" in finding.found
    assert links_here() is None


def test_links_to_another_disk(tmp_path: Path, small_disk: Path) -> None:
    (tmp_path / ".dvc").mkdir()
    (tmp_path / ".dvc" / "config").write_text(f"[cache]\n    dir = {small_disk / 'cache'}\n")
    found = read_cache(tmp_path)
    assert found is not None
    assert "hardlink" not in found.working
    assert not found.same_disk and found.link == "copy"


def test_limits() -> None:
    assert {finding.level for finding in check_limits(ROOM)} == {"ok"}
    small = check_limits(replace(ROOM, open_files=256, shared=64 * 2**20))
    assert {finding.subject: finding.remedy for finding in small if finding.level == "note"} == {
        "open files": "ulimit -n 4096",
        "/dev/shm": "in a container, start it with --shm-size=8g",
    }
    assert len(check_limits(replace(ROOM, shared=None))) == 3


def test_this_machines_limits_can_be_read() -> None:
    here = read_limits()
    assert here.cores > 0 and here.open_files > 0
    assert here.memory > 2**28
