"""Arrays and tables of numbers: what their files may not hold."""

import struct
import warnings
import zipfile

import numpy as np
import pytest

from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import read_csv, read_npy, read_npz
from pipeline.data.recording import check_clock, check_unpacked

MEND = "Copy the file again, or leave the episode out"
SMALL = MediaLimits(array_bytes=2**20, ratio=1)


def npy(shape: str, body: bytes = b"", dtype: str = "<f8", version: bytes = b"\1\0") -> bytes:
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + body


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy("(1000000000000,)"), r"\(1000000000000,\) of float64 is not what its 0 bytes hold"),
        (npy("(-1,)", bytes(8)), "is not what its 8 bytes hold"),
        (npy("(True,)", bytes(8)), "is not what its 8 bytes hold"),
        (npy("(1,)", bytes(8), "|V8"), "expected an array of numbers, found void"),
        (npy("(1,)", bytes(8), "|O"), "expected an array of numbers, found object"),
        (npy("(1,)", bytes(8), version=b"\x09\0"), "its header is damaged or not numpy's"),
        (npy("(" * 5000), "its header is damaged or not numpy's"),
        (npy("(200000,)", bytes(1_600_000)), "at most 1,048,576 bytes unpacked.* Leave the"),
        (npy("(2147483648, 0)"), r"expected rows with values, found \(2147483648, 0\) of float64"),
        (npy("()", bytes(8)), r"expected rows of numbers, found the single 0\.0"),
    ],
)
def test_arrays_are_what_their_bytes_hold(tmp_path, content, message):
    path, packed = tmp_path / "a.npy", tmp_path / "a.npz"
    path.write_bytes(content)
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path, "values.npy")
    for attempt, place in (
        (lambda: read_npy(path, SMALL), "a.npy"),
        (lambda: read_npz(packed, ["values"], limits=SMALL), "a.npz, member 'values'"),
    ):
        with pytest.raises(RecordingError, match=rf"{place}: .*{message}") as refused:
            attempt()
        assert "pickle" not in str(refused.value)


def test_an_array_may_have_no_rows_and_lists_of_words_end(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, values=np.zeros((0, 7)), names=np.zeros(65_537, "<U1"))
    assert read_npz(path, ["values"])["values"].shape == (0, 7)
    message = r"'names': expected a list of at most 65,536 words, found <U1 of shape \(65537,\)"
    with pytest.raises(RecordingError, match=message):
        read_npz(path, ["values"], text=["names"])


def test_what_unpacks_a_hundredfold_is_refused_unread():
    check_unpacked("a", 256 * 2**20, 1, MediaLimits())
    with pytest.raises(RecordingError, match=r"a: .*found 300,000,000\. .*raise limits\.ratio"):
        check_unpacked("a", 300_000_000, 2_000_000, MediaLimits())


@pytest.mark.parametrize(
    ("at", "value", "message"), [(8, 1, "encrypted"), (10, 99, "method"), (16, 1, "CRC")]
)
def test_a_spoilt_archive_is_named(tmp_path, at, value, message):
    path = tmp_path / "a.npz"
    np.savez(path, values=np.zeros(9999))
    content = bytearray(path.read_bytes())
    struct.pack_into("<H", content, content.find(b"PK\1\2") + at, value)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=rf"a\.npz, member 'values': .*{message}.*{MEND}"):
        read_npz(path, ["values"])


def test_a_member_stands_once(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, values=np.zeros(3))
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr("values.npy", npy("(0,)"))
    with pytest.raises(RecordingError, match=rf"'values': expected once, found twice. {MEND}"):
        read_npz(path, ["values"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n1_0,2\n", r"line 3, column 'a': '1_0' is not a number"),
        ("a,b\n1,١٢\n", r"line 2, column 'b': '١٢' is not a number"),
        ("a,b,a\n1,2,3\n", r"twice the column\(s\) a; it has a, b, a"),
        (",".join(f"c{n}" for n in range(99)), r"missing column\(s\) a, b; .* and 49 more"),
        ("a,b\n1," + "2" * 2**20 + "\n", "line 2: expected lines of fewer than 1,048,576"),
        ('a,b\n1,"' + "2" * 200_000 + '"\n', f"cannot be read as CSV: Error: field larger.*{MEND}"),
    ],
)
def test_a_table_is_bounded_and_holds_plain_numbers(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=rf"a\.csv.*{message}"):
        read_csv(path, ["a", "b"])


@pytest.mark.parametrize(
    ("time", "message"),
    [([0.0, 1e308], r"x: timestamp 1e\+308 in row 1"), ([np.nan], "x: timestamp nan in row 0")],
)
def test_no_clock_is_farther_than_any(time, message):
    with pytest.raises(RecordingError, match=message):
        check_clock(np.array(time), "x")
