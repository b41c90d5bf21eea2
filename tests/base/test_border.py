"""Whatever comes in is bounded, and refused with file, place, expected, found and mend."""

import os
from pathlib import Path

import pytest

from pipeline.base.documents import Border, Document, Text, named, shown
from pipeline.base.errors import RecordingError, StoreIncomplete

BORDER = Border(RecordingError, "Copy it again.")


class Camera(Document):
    name: Text
    rate: float = 30.0


class Robot(Document):
    cameras: tuple[Camera, ...]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"cameras": [{"name": "a"}, {"name": 3}]}', "cameras.1.name: expected a valid string"),
        (b'{"cameras": [{}]}', "cameras.0.name: missing"),
        (b'{"cameras": [{"name": "a", "rate": NaN}]}', "cameras.0.rate: expected a finite number"),
        (b'{"cameras": [{"name": "a\\u0000b"}]}', "cameras.0.name: expected a text to match"),
        (b'{"cameras": [' + b"[" * 10_000, "cannot be read as JSON: recursion limit exceeded"),
        (b'{"cameras": [' + b"{}," * 500_000 + b"{}]}", "expected a document of weight 4,000,000"),
        (b"\xff", "cannot be read as JSON"),
        (b" " * 101, "expected at most 100 bytes, found 101"),
    ],
)
def test_a_document_is_the_model_or_one_message(tmp_path, content, message):
    path = tmp_path / "robot.json"
    path.write_bytes(content)
    most = 100 if content.isspace() else 2**25
    with pytest.raises(RecordingError) as refused:
        BORDER.read_json(path, Robot, most)
    text = str(refused.value)
    assert text.startswith(f"{path}: ") and message in text and text.endswith("Copy it again.")
    assert len(text) < 1000


def test_unknown_keys_are_left_alone_and_types_are_not_guessed() -> None:
    read = BORDER.parse_json('{"cameras": [{"name": "a", "rate": 5, "new": 1}]}', Robot, "here")
    assert read == Robot(cameras=(Camera(name="a", rate=5.0),))
    with pytest.raises(RecordingError, match=r"here: cameras\.0\.rate: expected a valid number"):
        BORDER.parse_json('{"cameras": [{"name": "a", "rate": "5"}]}', Robot, "here")


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Path.mkdir, "expected a file, found a folder"),
        (os.mkfifo, "expected a file, found a pipe, socket or device"),
        (lambda path: path.symlink_to("nowhere"), "no such file"),
        (lambda path: path.symlink_to(path), "cannot be read: Too many levels of symbolic links"),
    ],
)
def test_only_regular_files_are_opened(tmp_path, make, message):
    make(tmp_path / "f")
    with pytest.raises(RecordingError, match=message):
        BORDER.read_bytes(tmp_path / "f")


def test_lines_are_bounded_and_named(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    path.write_text('{"name": "a"}\n\n{"name": "b"}\n{"name": 1}\n')
    lines = BORDER.read_json_lines(path, Camera)
    assert [next(lines).name, next(lines).name] == ["a", "b"]
    with pytest.raises(RecordingError, match=r"lines, line 4: name: expected a valid string"):
        next(lines)
    with pytest.raises(RecordingError, match=r"line 1: expected at most 5 bytes, found more"):
        next(BORDER.read_json_lines(path, Camera, most=5))


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("one\n two"), "f: cannot be read: ValueError: one two. Copy it again."),
        (EOFError(), "f: cannot be read: EOFError. Copy it again."),
        (PermissionError(13, "Permission denied"), "f: cannot be read: Permission denied."),
    ],
)
def test_an_error_of_another_library_becomes_one_sentence(error: Exception, message: str) -> None:
    with pytest.raises(RecordingError) as refused, BORDER.foreign("f", "cannot be read"):
        raise error
    assert message in str(refused.value)


def test_our_own_refusals_and_ctrl_c_pass() -> None:
    for error in (StoreIncomplete("ours"), KeyboardInterrupt()):
        with pytest.raises(type(error)), BORDER.foreign("f", "cannot be read"):
            raise error


def test_what_is_shown_can_be_printed_anywhere() -> None:
    assert shown("\ud800" * 3).isascii() and len(shown("x" * 10_000)) < 200
    assert named("a/b c") == "a/b c" and "\x1b" not in named("\x1b[31m")
    assert shown([10**5000]) == "[an integer of 16610 bits]"
