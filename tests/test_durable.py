"""Whatever a kill leaves behind, there is one whole folder, the old or the new."""

import os
from pathlib import Path

import pytest
import torch

from pipeline.durable import (
    read_document,
    read_tensors,
    recover_folder,
    replace_folder,
    write_document,
    write_tensors,
)
from pipeline.errors import CheckpointIncomplete


def put(folder: Path, text: str) -> None:
    replace_folder(folder, lambda temporary: (temporary / "a").write_text(text) and None)


class Killed(BaseException):
    """Stands for the end of the process: nothing after it runs, no clean-up either."""


@pytest.mark.parametrize("survived", range(6))
def test_a_kill_between_any_two_steps_leaves_the_old_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, survived: int
) -> None:
    folder = tmp_path / "last"
    put(folder, "old")
    steps = 0

    def counted(real):
        def step(*arguments, **keywords):
            nonlocal steps
            if steps == survived:
                raise Killed
            steps += 1
            return real(*arguments, **keywords)

        return step

    def gone(path: Path) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", counted(Path.rename))
        patched.setattr("pipeline.durable.sync", counted(lambda path: None))
        patched.setattr("shutil.rmtree", gone)
        with pytest.raises(Killed):
            put(folder, "new")
    recover_folder(folder)
    assert (folder / "a").read_text() == ("new" if survived >= 4 else "old")
    assert os.listdir(tmp_path) == ["last"]


def test_a_failed_write_keeps_the_old(tmp_path: Path) -> None:
    folder = tmp_path / "last"
    put(folder, "old")

    def full(temporary: Path) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        replace_folder(folder, full)
    assert (folder / "a").read_text() == "old"
    assert os.listdir(tmp_path) == ["last"]


def test_a_document_comes_back_to_the_bit(tmp_path: Path) -> None:
    document = {"pi": 0.1 + 0.2, "tiny": 5e-324, "text": "µm", "none": None}
    write_document(tmp_path / "d.json", document)
    assert read_document(tmp_path / "d.json") == document


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"a": \x00}'])
def test_a_damaged_document_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "d.json"
    path.write_text(content)
    with pytest.raises(CheckpointIncomplete, match=r"d\.json: the checkpoint is damaged"):
        read_document(path)


def test_tensors_come_back_and_damage_is_found(tmp_path: Path) -> None:
    path = tmp_path / "t.safetensors"
    tensors = {"a": torch.arange(12.0).view(3, 4).T, "b": torch.ones((), dtype=torch.bfloat16)}
    digest = write_tensors(path, tensors)
    found = read_tensors(path, digest)
    assert all(torch.equal(found[name], value) for name, value in tensors.items())
    assert path.stat().st_mode & 0o777 == tmp_path.stat().st_mode & 0o666

    whole = path.read_bytes()
    for broken in (whole[:-1], whole[:40], b"", whole[:-1] + bytes([whole[-1] ^ 1])):
        path.write_bytes(broken)
        with pytest.raises(CheckpointIncomplete, match="sha256"):
            read_tensors(path, digest)
    path.unlink()
    with pytest.raises(CheckpointIncomplete, match="no such file"):
        read_tensors(path, digest)
