"""Messages are those of openpi-client, nothing of them is run, and all of them is bounded."""

import pickle
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.base.errors import WireError
from pipeline.robot import wire

NUMBERS = st.one_of(
    arrays.boolean_dtypes(),
    arrays.integer_dtypes(endianness="?"),
    arrays.unsigned_integer_dtypes(endianness="?"),
    arrays.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
)


@given(arrays.arrays(NUMBERS, arrays.array_shapes(min_dims=0, min_side=0, max_side=4)))
def test_arrays_come_back_as_they_were(array: np.ndarray) -> None:
    back = wire.unpack(wire.pack({"a": array}))["a"]
    assert back.shape == array.shape and back.dtype == array.dtype.newbyteorder("=")
    np.testing.assert_array_equal(back, array)
    assert back.flags.writeable and back.flags.owndata


def test_a_message_is_byte_for_byte_that_of_openpi_client() -> None:
    """What its msgpack_numpy makes of an array and of a number, written out."""
    array, number = np.arange(6, dtype=">i2").reshape(2, 3), np.int16(7)
    described = {
        b"__ndarray__": True, b"data": array.tobytes(), b"dtype": ">i2", b"shape": (2, 3)
    }  # fmt: skip
    plain = {b"__npgeneric__": True, b"data": 7, b"dtype": "<i2"}
    theirs = msgpack.packb({"array": described, "number": plain, "text": "é", "list": [1, None]})
    ours = {"array": array, "number": number, "text": "é", "list": [1, None]}
    assert wire.pack(ours) == theirs
    back = wire.unpack(theirs)
    np.testing.assert_array_equal(back["array"], array)
    assert back["number"] == 7 and isinstance(back["number"], np.int16)
    assert (back["text"], back["list"]) == ("é", [1, None])


@pytest.mark.parametrize(
    "value",
    [np.array([None]), np.zeros(2, complex), np.zeros(2, [("a", "f4")]), {1, 2}, 2**70],
)
def test_what_is_no_plain_number_is_not_sent(value: Any) -> None:
    with pytest.raises(WireError, match="cannot be sent"):
        wire.pack({"a": value})


class Trap:
    def __reduce__(self) -> Any:
        return pytest.fail, ("unpickled",)


def array_of(dtype: Any, shape: Any, data: Any) -> bytes:
    return msgpack.packb({b"__ndarray__": True, b"dtype": dtype, b"shape": shape, b"data": data})


def number_of(dtype: Any, value: Any) -> bytes:
    return msgpack.packb({b"__npgeneric__": True, b"dtype": dtype, b"data": value})


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (msgpack.packb({"a": 1})[:-1], "incomplete"),
        (b"\x91" * 100_000 + b"\xc0", "expected a message in msgpack"),
        (b"\x91" * 13 + b"\xc0", "at most 12 levels"),
        (msgpack.packb([[0] * 9999] * 3), "at most 20000 entries"),
        (msgpack.packb("x" * 1_000_001), "expected a message in msgpack"),
        (pickle.dumps(Trap()), "expected a message in msgpack"),
        (array_of("|O", [1], pickle.dumps(Trap())), "found '|O'"),
        (array_of("<f4", [2], b"0" * 4), "expected 8 bytes"),
        (array_of("<f4", [-1], b""), "shape of an array"),
        (array_of("<f4", [1] * 9, b"0" * 4), "shape of an array"),
        (array_of("<f4", [2**31, 2**62], b"0" * 4), "expected 39614081257132168796771975168 bytes"),
        (array_of("<f4", [1], "0000"), "expected 4 bytes for an array of float32, found str"),
        (number_of("<i2", 70_000), "expected a message in msgpack"),
        (number_of("<i2", "7"), "expected a number"),
    ],
)  # fmt: skip
def test_a_broken_message_is_one_error(data: bytes, said: str) -> None:
    with pytest.raises(WireError) as refused:
        wire.unpack(data)
    assert said in str(refused.value) and len(str(refused.value)) < 300


def test_a_message_may_be_as_long_as_the_caller_allows() -> None:
    data = wire.pack(np.zeros(100))
    assert len(wire.unpack(data, len(data))) == 100
    with pytest.raises(WireError, match="at most 100 bytes"):
        wire.unpack(data, 100)
