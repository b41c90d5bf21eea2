"""What somebody else wrote lies where a command writes: nobody's work is replaced or removed."""

import os
import shutil
from pathlib import Path

import pytest
import zarr

from pipeline.base.errors import ConfigError
from pipeline.base.files import MARKER, REPORT, refuse_foreign
from pipeline.store.archive import archive
from pipeline.store.paths import STORE
from tests.store.samples import content

PRESS = 'data.sources=[{"name": "made", "path": "Press"}]'
WRITERS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "extract": ("stages.extract", "x.zarr", ("extract.store={}",)),
    "plan": ("stages.extract", "x.zarr", ("extract.store={}", "extract.plan=true")),
    "build": ("stages.extract", "stores/made.zarr.part", ()),
    "ledger": ("stages.extract", "x.zarr.files.sqlite", ("extract.store={tmp}/x.zarr",)),
    "lost": ("stages.extract", "stores/made.zarr.previous", (PRESS,)),
    "recordings": ("stages.demo", "demo", ("demo.recordings={}",)),
    "checkpoint": ("stages.demo", "vlm", ("demo.checkpoint={}", "demo.recordings={tmp}/demo")),
    "new": ("stages.demo", "vlm.new", ("demo.checkpoint={tmp}/vlm", "demo.recordings={tmp}/demo")),
    "merge": ("stages.store", "x.zarr", ("stores.output={}",)),
    "merge build": ("stages.store", "x.zarr.part", ("stores.output={tmp}/x.zarr",)),
    "archive": ("stages.archive", "x.zarr", ("archive.output={}",)),
    "archive build": ("stages.archive", "x.zarr.part", ("archive.output={tmp}/x.zarr",)),
    "restore": ("stages.archive", "x.zarr", ("archive.store={}",)),
    "restore build": ("stages.archive", "x.zarr.part", ("archive.store={tmp}/x.zarr",)),
    "repair": ("stages.verify", "stores/made.zarr.part", ("verify.repair=true",)),
    "head": ("stages.train_head", "x", ("train_head.output={}",)),
    "head build": ("stages.train_head", "head.part", ()),
    "head logs": ("stages.train_head", "x", ("train_head.logs={}",)),
    "head lock": ("stages.train_head", "head.lock", ()),
    "tuned": ("stages.finetune", "x", ("finetune.output={}",)),
    "tuned logs": ("stages.finetune", "x", ("finetune.logs={}", "finetune.output={tmp}/tuned")),
    "evaluate": ("stages.evaluate", "x", ("evaluate.output={}",)),
    "inspect": (
        "stages.inspect",
        "x",
        ("inspect.output={}", "inspect.path={tmp}/stores/made.zarr"),
    ),
    "probe": ("stages.probe", "x", ("probe.output={}",)),
    "compare": ("stages.compare", "x", ("compare.output={}",)),
}
"""By name: the command, where something foreign lies, and what sets the command to write there."""


def plant(place: Path, foreign: str) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    if foreign == "file":
        place.write_text("years of work")
        os.utime(place, (0, 0))  # no living holder of a lock either
    elif foreign == "zarr group":
        zarr.create_array(place, name="data/action", shape=(3,), dtype="f4")
    else:
        (place / "chapters").mkdir(parents=True)
        (place / "chapters" / "thesis.txt").write_text("years of work")


@pytest.mark.parametrize(
    ("writer", "foreign"),
    [
        pytest.param(writer, kind, marks=[pytest.mark.slow] * (turn % 3 != at))
        for turn, writer in enumerate(WRITERS)
        for at, kind in enumerate(("folder", "file", "zarr group"))
    ],
)
def test_is_left_as_it_is(writer, foreign, params, here, tmp_path):
    command, below, settings = WRITERS[writer]
    store, place = tmp_path / "stores" / "made.zarr", tmp_path / below
    options = [one.replace("{}", str(place)).replace("{tmp}", str(tmp_path)) for one in settings]
    if writer.startswith("merge"):
        copy = Path(shutil.copytree(store, tmp_path / "copy.zarr"))
        options += ["stores.action=merge", f"stores.inputs=[{store}, {copy}]"]
    if writer.startswith("restore"):
        archive(store, tmp_path / "a.zarr", level=1, threads=1)
        options += ["archive.restore=true", f"archive.output={tmp_path / 'a.zarr'}"]
    if writer.startswith("repair"):
        file = store / "tick" / "time" / "c" / "0"
        file.write_bytes(bytes(8) + file.read_bytes()[8:])
    plant(place, foreign)
    before = place.read_bytes() if foreign == "file" else content(place)
    code, _, complained = here(command, params, *(w for one in options for w in ("--set", one)))
    assert code == 2, complained
    assert str(place) in complained
    assert not (tmp_path / "demo" / "raw").exists(), "the work begins before the refusal"
    assert "Traceback" not in complained
    assert (place.read_bytes() if foreign == "file" else content(place)) == before


def test_a_marker_that_a_kill_cut_off_makes_no_folder_foreign(tmp_path: Path) -> None:
    (tmp_path / MARKER).touch()
    assert STORE.owns(tmp_path)
    (tmp_path / "thesis.txt").write_text("years of work")
    assert not STORE.owns(tmp_path)


def test_a_folder_of_reports_is_known_by_its_marker_alone(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text('<meta name="pictures" content="">')
    with pytest.raises(ConfigError, match=r"Reports of earlier .* move or remove"):
        refuse_foreign(tmp_path, REPORT)
    (tmp_path / MARKER).write_text("a folder of reports\n")
    refuse_foreign(tmp_path, REPORT)
