"""Arrays and tables of numbers: what their files may not hold."""

import struct
import zipfile

import numpy as np
import pytest

from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import read_csv, read_npy, read_npz
from pipeline.data.recording import check_clock

MEND = "Copy or write the file again, or leave the episode out"
SMALL = MediaLimits(array_bytes=2**20)


def npy(shape: str, body: bytes = b"", dtype: str = "<f8") -> bytes:
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + body


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy("(1000000000000,)"), f"cannot be read as an array: cut off.*{MEND}"),
        (npy("(1,)", bytes(8), "|V8"), "expected rows of numbers, found .V8"),
        (npy("(1,)", bytes(8), "|O"), f"cannot be read as an array: .*of objects.*{MEND}"),
        (npy("()", bytes(8)), "expected rows of numbers, found float64"),
        (npy("(" * 5000), f"cannot be read.*{MEND}"),
        (npy("(200000,)", bytes(1_600_000)), "at most 1,048,576 bytes unpacked.* Leave the"),
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


def test_an_encrypted_archive_is_named(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, values=np.zeros(9999))
    content = bytearray(path.read_bytes())
    struct.pack_into("<H", content, content.find(b"PK\1\2") + 8, 1)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=rf"a\.npz, member 'values': .*encrypted.*{MEND}"):
        read_npz(path, ["values"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n1_0,2\n", "Row #3: .*invalid value '1_0'"),
        ("a,b,a\n1,2,3\n", "expected one column a each; it has a, b, a"),
        ("a,b\n1," + "2" * 2**21 + "\n", f"cannot be read as CSV.*{MEND}"),
        ("a,b\n1,\n", "column 'b': no value in row 0"),
    ],
)
def test_a_table_is_bounded_and_holds_plain_numbers(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=rf"a\.csv.*{message}"):
        read_csv(path, ["a", "b"])


def test_no_time_of_a_clock_is_nan():
    with pytest.raises(RecordingError, match="x: timestamp nan in row 1"):
        check_clock(np.array([0.0, np.nan]), "x")
