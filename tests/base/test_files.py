"""Whatever a kill leaves behind, there is one whole folder, the old or the new."""

import json
import os
from functools import partial
from pathlib import Path

import pytest
import torch

from pipeline.base import files
from pipeline.base.errors import CheckpointIncomplete, DiskFull
from pipeline.base.files import (
    OutputKind,
    check_digest,
    fresh,
    put_in_place,
    read_document,
    read_tensors,
    recover,
    recover_folder,
    replace_folder,
    write_document,
    write_tensors,
    write_with_digest,
)
from tests.faults.killing import Killed, killed_before

KIND = OutputKind("a folder of this test", lambda folder: (folder / "a").is_file())


def put(folder: Path, text: str) -> None:
    replace_folder(folder, lambda temporary: (temporary / "a").write_text(text) and None, KIND)


@pytest.mark.parametrize("survived", [0, 4, 5, 6])
def test_a_kill_between_any_two_steps_leaves_the_old_or_the_new(tmp_path, monkeypatch, survived):
    folder, steps = tmp_path / "last", ((Path, "rename"), (files, "sync"))
    put(folder, "old")

    def gone(path: Path) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr("shutil.rmtree", gone)
        assert killed_before(survived, partial(put, folder, "new"), steps)
    recover_folder(folder, KIND)
    assert (folder / "a").read_text() == ("new" if survived >= 5 else "old")
    assert os.listdir(tmp_path) == ["last"]


@pytest.mark.parametrize("linked", [False, True])
def test_a_kill_at_any_step_of_a_replacement_is_undone_or_completed(tmp_path, linked):
    """Kill before the n-th change of the folder, for every n, until none is left."""
    for kill_at in range(40):
        here = tmp_path / str(kill_at)
        target, complete = here / "last", here / "complete"
        put(target, "old")
        if linked:
            target.rename(here / "big")
            target.symlink_to("big")
        put(complete, "new")
        finished = not killed_before(kill_at, partial(put_in_place, complete, target, KIND))
        recover(complete, target, KIND)
        now = (target / "a").read_text()
        assert not finished or now == "new"
        assert os.listdir(target) == ["a"]
        assert {path.name for path in here.iterdir()} <= {"last", "complete", "big"}
        assert not linked or (here / "big" / "a").read_text() == "old"
        if finished:
            assert kill_at >= 4
            return
    raise AssertionError("more steps than expected")


def test_a_failed_write_keeps_the_old(tmp_path: Path) -> None:
    folder = tmp_path / "last"
    put(folder, "old")

    def full(temporary: Path) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(DiskFull, match=f"{folder}: no space left"):
        replace_folder(folder, full, KIND)
    assert (folder / "a").read_text() == "old"
    assert os.listdir(tmp_path) == ["last"]


def test_a_document_with_a_digest_says_when_it_was_altered(tmp_path: Path) -> None:
    path = tmp_path / "d.json"
    numbers = {"µ": 0.1 + 0.2, "tiny": 5e-324}
    document = {**numbers, "ticks": (0, 30), "by number": {10: 1, 9: 2}, "none": None}
    write_with_digest(path, document)
    read = {**document, "ticks": [0, 30], "by number": {"10": 1, "9": 2}}
    assert read_document(path, dict) == (json.loads(path.read_text()), read)
    assert read_document(path, dict)[1] == read
    path.write_text(json.dumps(json.loads(path.read_text()), sort_keys=True))
    assert read_document(path, dict)[1] == read, "neither spaces nor the order of keys are content"
    path.write_text(path.read_text().replace("30]", "31]"))
    with pytest.raises(CheckpointIncomplete, match=r"d\.json: it was altered"):
        read_document(path, dict)[1]
    write_document(path, document)
    assert read_document(path, dict) == (read, read)


@pytest.mark.parametrize("content", ["", "[1]"])
def test_a_damaged_document_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "d.json"
    path.write_text(content)
    with pytest.raises(CheckpointIncomplete, match=r"d\.json: .*Copy it again"):
        read_document(path, dict)[1]


def test_only_a_document_with_its_digest_may_be_as_long_as_a_long_run(tmp_path, monkeypatch):
    for limit in ("MOST_WEIGHT", "_MOST_WEIGHT"):  # so that the document is a hundredth as long
        monkeypatch.setattr(files, limit, getattr(files, limit) // 100)
    path = tmp_path / "d.json"
    document = {"rows": [[step, {"loss": 0.5}] for step in range(2000)]}
    write_with_digest(path, document)
    assert read_document(path, dict)[1] == document
    write_document(path, document)
    with pytest.raises(CheckpointIncomplete, match=r"d\.json: expected a document of weight"):
        read_document(path, dict)


def test_tensors_come_back_and_damage_is_found(tmp_path: Path) -> None:
    path = tmp_path / "t.safetensors"
    tensors = {"a": torch.arange(12.0).view(3, 4).T, "b": torch.ones((), dtype=torch.bfloat16)}
    digest = write_tensors(path, tensors)
    found = read_tensors(path, digest)
    assert all(torch.equal(found[name], value) for name, value in tensors.items())
    assert path.stat().st_mode & 0o777 == tmp_path.stat().st_mode & 0o666

    whole = path.read_bytes()
    for broken in (whole[:-1], whole[:40], b""):
        path.write_bytes(broken)
        with pytest.raises(CheckpointIncomplete, match=r"t\.safetensors: cut off or damaged"):
            read_tensors(path, digest)
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(CheckpointIncomplete, match="sha256"):
        read_tensors(path, digest)
    os.truncate(path, 2**40)  # of holes: its digest would take an hour
    with pytest.raises(CheckpointIncomplete, match="cut off or damaged"):
        check_digest(path, digest)
    path.unlink()
    with pytest.raises(CheckpointIncomplete, match="no such file"):
        read_tensors(path, digest)


def test_tensors_on_a_full_disk_are_named_and_the_old_stand(small_disk: Path) -> None:
    """On a real one: safetensors has an error of its own."""
    folder = small_disk / "last"

    def write(megabytes: int) -> None:
        tensors = {"a": torch.zeros(megabytes * 2**18)}
        replace_folder(
            folder, lambda temporary: write_tensors(temporary / "a", tensors) and None, KIND
        )

    write(1)
    with pytest.raises(DiskFull, match="last: no space left"):
        write(16)
    assert (folder / "a").stat().st_size == pytest.approx(2**20, abs=200)
    assert os.listdir(small_disk) == ["last"]


def test_what_is_no_full_disk_keeps_its_error(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        replace_folder(tmp_path / "a", lambda temporary: temporary.write_text("") and None, KIND)


def test_fresh_leaves_a_link_s_other_end_alone(tmp_path: Path) -> None:
    (tmp_path / "cached").write_text("old")
    (tmp_path / "file").hardlink_to(tmp_path / "cached")
    fresh(tmp_path / "file").write_text("new")
    assert (tmp_path / "cached").read_text() == "old"
