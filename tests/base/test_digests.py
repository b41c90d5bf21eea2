"""Content digests are remembered until a file's size or time changes."""

import os
import sqlite3
from contextlib import closing

import pytest

from pipeline.base.digests import ContentDigests
from pipeline.base.errors import ConfigError, RecordingError


def test_reads_a_file_once_and_notices_a_change(tmp_path, monkeypatch):
    ledger, file = tmp_path / "ledger.sqlite", tmp_path / "file"
    file.write_bytes(b"one")
    (tmp_path / "copy").write_bytes(b"one")
    with closing(ContentDigests(ledger)) as digests:
        first = digests.of(file)
        assert digests.of(tmp_path / "copy") == first, "of its content, wherever it lies"
    monkeypatch.setattr("pipeline.base.digests.file_digest", lambda path: "read again")
    with closing(ContentDigests(ledger)) as digests:
        assert digests.of(file) == first
        os.utime(file, ns=(1, 1))
        assert digests.of(file) == "read again"


def test_a_damaged_ledger_is_begun_anew(tmp_path):
    ledger = tmp_path / "ledger.sqlite"
    with closing(ContentDigests(ledger)) as digests:
        digests.note_rate("model", 12.5)
    ledger.write_bytes(damaged := ledger.read_bytes()[:100] + b"no database" * 50)
    (tmp_path / "file").write_bytes(b"one")
    with closing(ContentDigests(ledger)) as digests:
        assert digests.rate("model") is None
        assert len(digests.of(tmp_path / "file")) == 32
    assert ledger.read_bytes() != damaged


@pytest.mark.parametrize(
    ("kind", "opened"),
    [
        ("text", ContentDigests),
        ("folder", ContentDigests.to_read),
        ("another application", ContentDigests),
    ],
)
def test_what_is_no_ledger_is_left_as_it_is(tmp_path, kind, opened):
    ledger = tmp_path / "ledger.sqlite"
    if kind == "text":
        ledger.write_text("years of work")
    elif kind == "folder":
        ledger.mkdir()
    else:
        with closing(sqlite3.connect(ledger)) as database:
            database.execute("PRAGMA application_id = 7")
            database.execute("CREATE TABLE file (thesis TEXT)")
    before = ledger.is_file() and ledger.read_bytes()
    with pytest.raises(ConfigError, match="did not write"):
        opened(ledger)
    assert (ledger.is_file() and ledger.read_bytes()) == before
    assert list(tmp_path.iterdir()) == [ledger]


def test_what_only_reads_needs_no_write_access(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"one")
    ledger = tmp_path / "ledger.sqlite"
    with closing(ContentDigests(ledger)) as digests:
        digests.note_rate("model", 12.5)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    real = sqlite3.connect

    def read_only(place, **how):
        if place == ledger:
            how["uri"], place = True, f"file:{ledger}?mode=ro&immutable=1"
        return real(place, **how)

    monkeypatch.setattr("pipeline.base.digests.sqlite3.connect", read_only)
    with (
        closing(ContentDigests(ledger)) as digests,
        pytest.raises(ConfigError, match="cannot be written"),
    ):
        digests.of(tmp_path / "file")
    with closing(ContentDigests.to_read(ledger)) as digests:
        assert digests.rate("model") == 12.5
        assert len(digests.of(tmp_path / "file")) == 32
    with closing(ContentDigests.to_read(tmp_path / "file" / "below")) as digests:
        assert digests.rate("model") is None
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_remembers_speeds_and_texts(tmp_path):
    with closing(ContentDigests(tmp_path / "ledger.sqlite")) as digests:
        assert digests.rate("model") is None
        digests.note_rate("model", 12.5)
        assert digests.text("name", lambda: "text") == "text"
    with closing(ContentDigests(tmp_path / "ledger.sqlite")) as digests:
        assert digests.rate("model") == 12.5
        assert digests.text("name", lambda: "made again") == "text"
        assert digests.text("another", lambda: "made again") == "made again"


@pytest.mark.parametrize("opened", [ContentDigests, ContentDigests.to_read])
def test_a_ledger_whose_pages_are_damaged_gives_no_wrong_digest(tmp_path, opened):
    """Some pages are emptied, or have a bit flipped in each 64 bytes."""
    ledger, files = tmp_path / "ledger.sqlite", [tmp_path / f"file{i}" for i in range(8)]
    for file in files:
        file.write_text(file.name)
    with closing(ContentDigests(ledger)) as digests:
        expected = [digests.of(file) for file in files]
        digests.note_rate("model", 12.5)
    sound = ledger.read_bytes()
    for start in range(100, len(sound), 4096 * 5):
        flipped = bytearray(sound)
        for index in range(start, min(start + 3996, len(sound)), 64):
            flipped[index] ^= 4
        emptied = sound[:start] + bytes(4096) + sound[start + 4096 :]
        for content in (flipped, emptied, sound[:start]):
            ledger.write_bytes(content)
            with closing(opened(ledger)) as digests:
                assert [digests.of(file) for file in files] == expected
                assert digests.rate("model") in (12.5, None)


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with closing(ContentDigests(None)) as digests:
        for name, why in (("pipe", "expected a file, found a pipe"), ("gone", "no such file")):
            with pytest.raises(RecordingError, match=rf"{name}: {why}.*Copy the file again"):
                digests.of(tmp_path / name)


def test_a_path_that_is_no_unicode_has_a_digest(tmp_path):
    (tmp_path / "a\udcff").write_text("one")
    with closing(ContentDigests(tmp_path / "ledger.sqlite")) as digests:
        assert digests.of(tmp_path / "a\udcff") == digests.of(tmp_path / "a\udcff")
        digests.note_bad("episode", "a\udcff: damaged")
        assert digests.bad("episode") == "a\udcff: damaged"
