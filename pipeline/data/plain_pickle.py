"""Reads pickles that hold only numpy arrays and plain containers.

A pickle names functions and classes, and the unpickler calls them. This module knows only the names
needed for arrays, numpy scalars, bytes and sets, and replaces each with a function of its own that
checks its arguments. Any other name is refused before it is looked up.
"""

import pickle
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.border import shown
from pipeline.data.media import INTACT, RECORDINGS, check_limit

_DTYPE = re.compile(r"[<>=|]?(\?|[biuf][1248]|[SU]\d{1,6})")


class _Refused(Exception):
    """The pickle asks for something that is not allowed; other errors mean damage."""


class _Dtype:
    """Replaces `numpy.dtype`, whose own state could turn numbers into pointers."""

    def __init__(self, code: Any, *_: Any) -> None:
        if not isinstance(code, str) or not _DTYPE.fullmatch(code):
            raise _Refused(f"an array of dtype {shown(code)}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array whose state follows it in the pickle, as in protocols below 5."""

    def __setstate__(self, state: Any, /) -> None:
        _, shape, dtype, fortran, data = state
        super().__setstate__((1, shape, dtype.dtype, fortran, data))


def _reconstruct(*_: Any) -> _Array:
    return np.empty(0, np.int8).view(_Array)


def _frombuffer(data: Any, dtype: _Dtype, shape: Any, order: str, axes: Any = None) -> Any:
    if not isinstance(data, bytes | bytearray):  # an array would share its memory
        raise _Refused("an array that shares the memory of another")
    flat = np.frombuffer(data, dtype.dtype)
    array = flat.reshape(shape, order="F" if order == "F" else "C")
    return array if axes is None else array.transpose(axes)


def _scalar(dtype: _Dtype, data: bytes) -> Any:
    return np.frombuffer(data, dtype.dtype)[0].item()


def _latin1(text: str, encoding: str) -> bytes:
    """Bytes as protocol 2 writes them."""
    if encoding != "latin1":
        raise _Refused(f"encoding {shown(encoding)}")
    return text.encode("latin1")


_CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _Dtype,
    "numpy._core.multiarray._reconstruct": _reconstruct,
    "numpy._core.multiarray.scalar": _scalar,
    "numpy._core.numeric._frombuffer": _frombuffer,
    "_codecs.encode": _latin1,
    "collections.OrderedDict": dict,
    "builtins.set": set,
    "builtins.frozenset": frozenset,
    "builtins.bytes": lambda: b"",
}
"""The functions that replace the names in a pickle."""
_SHARED = 100_000
"""How many values may repeat because a list is named more than once."""
_PLAIN = (str, bytes, bytearray, int, float, type(None), np.ndarray)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        # The spelling of numpy 2 and protocol 3.
        known = f"{module}.{name}".replace("numpy.core.", "numpy._core.")
        known = known.replace("__builtin__.", "builtins.")
        if known == "numpy.ndarray":  # an argument of _reconstruct, never called
            return None
        if known not in _CALLS:
            raise _Refused(shown(known).strip("'"))
        # A pickle can set attributes of a named object, so it gets a new one each time.
        return partial(_CALLS[known])


def _plain(value: Any, left: Iterator[int]) -> Any:
    """The value with plain numpy arrays; refuses other objects, and more values than `left` has.

    A list counts each time it is named, because a few bytes can name it a million times.
    """
    if next(left, None) is None:
        raise _Refused("the same lists again and again")
    if isinstance(value, dict):
        return {_plain(key, left): _plain(inner, left) for key, inner in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return type(value)(_plain(inner, left) for inner in value)
    if not isinstance(value, _PLAIN):
        raise _Refused("a dtype or a name without an array")
    if isinstance(value, int) and value.bit_length() > 64:
        raise _Refused("an integer of more than 64 bits")
    return np.asarray(value) if isinstance(value, _Array) else value


def load_plain(path: Path, most: int) -> Any:
    """The content of a pickle of numpy arrays, scalars, dicts, lists, tuples, sets and text.

    Numpy scalars become plain numbers. Raises `RecordingError`, and executes nothing, where the
    pickle asks for anything else, is damaged, or has more than `most` bytes.
    """
    size = RECORDINGS.check_file(path)
    check_limit(path, size, most, "array_bytes", "bytes")
    # Damaged bytes make numpy and the unpickler raise almost any exception.
    with RECORDINGS.foreign(path, "damaged pickle"), path.open("rb") as file:
        try:
            loaded = _Unpickler(file, encoding="latin1").load()
            return _plain(loaded, iter(range(size + _SHARED)))  # a value takes at least one byte
        except _Refused as error:
            raise INTACT.refusal(
                path,
                f"refused: it asks for {error}; only numpy arrays and plain containers are "
                "admitted, because a pickle can run code. Nothing was executed",
            ) from None
