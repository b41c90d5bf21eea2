"""Messages between robot and server: msgpack with numpy arrays, as openpi-client writes them.

Nothing in a message is ever executed or unpickled, and its size, depth and entries are bounded. A
wrong message is a `WireError`. Needs only numpy and msgpack.
"""

import math
import re
from collections.abc import Mapping
from typing import Any, Final

import msgpack
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import WireError

MAX_BYTES: Final = 64 * 2**20
"""Default limit of a message's size."""
MAX_DEPTH: Final = 12
MAX_ENTRIES: Final = 20_000
"""Entries of all lists and maps of a message together."""
MAX_TEXT: Final = 1_000_000
MAX_RANK: Final = 8

_DTYPE = re.compile(r"[<>|](b1|[iu][1248]|f[248])")
"""Booleans and plain numbers, as `dtype.str` names them."""


def pack(message: Any) -> bytes:
    """The bytes of a message of maps, lists, texts, numbers and numpy arrays.

    Raises `WireError` for anything else, and for arrays of other than plain numbers.
    """
    try:
        packed = msgpack.packb(message, default=_described)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError(f"a message cannot be sent: {error}") from None
    assert isinstance(packed, bytes)
    return packed


def unpack(data: bytes, max_bytes: int = MAX_BYTES) -> Any:
    """The message in these bytes; its arrays are copies in the byte order of this machine.

    Raises `WireError` for bytes that are no message, for a message beyond the bounds of this
    module, and for arrays of other than plain numbers or of a wrong size.
    """
    if len(data) > max_bytes:
        raise WireError(f"expected a message of at most {max_bytes} bytes, found {len(data)}")
    reader = _Reader()
    try:
        message = msgpack.unpackb(
            data,
            object_hook=reader.mapping,
            list_hook=reader.counted,
            max_str_len=MAX_TEXT,
            max_bin_len=max_bytes,
            max_array_len=MAX_ENTRIES,
            max_map_len=MAX_ENTRIES,
            max_ext_len=0,
        )
    except WireError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        why = str(error) or type(error).__name__
        raise WireError(f"expected a message in msgpack, found none: {why:.200}") from None
    _check_depth(message, MAX_DEPTH)
    return message


class _Reader:
    """Reads the maps and lists of one message, innermost first, and counts their entries."""

    def __init__(self) -> None:
        self._entries = 0

    def counted(self, value: Any) -> Any:
        """The same list or map, counted."""
        self._entries += 1 + len(value)
        if self._entries > MAX_ENTRIES:
            raise WireError(f"expected a message of at most {MAX_ENTRIES} entries, found more")
        return value

    def mapping(self, value: dict[Any, Any]) -> Any:
        """The array or number that a map describes, else the map itself."""
        self.counted(value)
        if b"__ndarray__" in value:
            return _array(value)
        return _number(value) if b"__npgeneric__" in value else value


def _described(value: Any) -> Any:
    """The map that describes a numpy array or number."""
    if not isinstance(value, np.ndarray | np.generic):
        raise TypeError(f"expected maps, lists, texts, numbers or arrays, found {type(value)}")
    if not _DTYPE.fullmatch(value.dtype.str):
        raise TypeError(f"expected numbers of at most 64 bits, found dtype {value.dtype}")
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return {
        b"__ndarray__": True,
        b"data": value.tobytes(),
        b"dtype": value.dtype.str,
        b"shape": value.shape,
    }


def _array(description: Mapping[Any, Any]) -> NDArray[Any]:
    dtype, data = _dtype(description), description.get(b"data")
    shape: Any = description.get(b"shape")
    sizes = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not sizes or len(shape) > MAX_RANK:
        raise WireError(f"expected the shape of an array, found {shape!r:.80}")
    size = math.prod(shape) * dtype.itemsize
    length = len(data) if isinstance(data, bytes) else type(data).__name__
    if length != size:
        raise WireError(f"expected {size} bytes for an array of {dtype}, found {length}")
    plain = np.ndarray(shape, dtype, buffer=data)
    return plain.astype(dtype.newbyteorder("="))


def _number(description: Mapping[Any, Any]) -> Any:
    value, dtype = description.get(b"data"), _dtype(description)
    if not isinstance(value, bool | int | float):
        raise WireError(f"expected a number, found {type(value).__name__}")
    with np.errstate(over="ignore"):
        return dtype.type(value)


def _dtype(description: Mapping[Any, Any]) -> np.dtype[Any]:
    name = description.get(b"dtype")
    if not isinstance(name, str) or not _DTYPE.fullmatch(name):
        raise WireError(f"expected the dtype of plain numbers such as '<f4', found {name!r:.80}")
    return np.dtype(name)


def _check_depth(value: Any, left: int) -> None:
    if not isinstance(value, dict | list):
        return
    if left == 0:
        raise WireError(f"expected a message of at most {MAX_DEPTH} levels, found a deeper one")
    for inner in value.values() if isinstance(value, dict) else value:
        _check_depth(inner, left - 1)
