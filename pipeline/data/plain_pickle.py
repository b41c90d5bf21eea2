"""Reading pickles that hold numpy arrays and plain containers, and nothing else.

A pickle names classes and has them called. Here the standard library's own reader, the one that is
written in Python, takes only the opcodes that data need, and a bounded number of them: no class is
looked up, nothing foreign is called. The few names that arrays, bytes and sets are written with
stand for functions of this module, which check what they are given.
"""

import pickletools
import re
from collections.abc import Callable, Mapping
from math import prod
from pathlib import Path
from pickle import _Unpickler  # pyright: ignore[reportPrivateUsage]
from struct import unpack
from sys import getsizeof
from typing import IO, Any

import numpy as np

from pipeline.base.border import shown
from pipeline.data.media import INTACT, RECORDINGS, check_limit

_DTYPE = re.compile(r"[<>=|]?(\?|[biuf][1248]|[SU]\d{1,6})")
_DEEPEST = 20
_MOST = 500_000
"""Opcodes of a pickle, and values in it; what stands in two places counts twice."""
_COPIED = 64 * 2**20
"""Bytes that calls may make of any file; of a larger one, twice its own. What is no call takes its
bytes from the file, or a few for a step."""
_LONGEST = 40_000
"""Bytes of a key, of a member of a set and of a scalar, which may be gone over at every step."""
_MOST_DIMENSIONS = 64
_KEYS = (str, bytes, int, float, type(None))
_PLAIN = (*_KEYS, bytearray, np.ndarray)


class _Refused(Exception):
    """The pickle asks for something that is not admitted; other errors are damage."""


class _Dtype:
    """Stands for `numpy.dtype`: only booleans, numbers and text."""

    def __init__(self, code: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or not _DTYPE.fullmatch(code):
            raise _Refused(f"an array of dtype {shown(code)}")
        self.dtype = np.dtype(code)


def _build(built: Any, state: Any) -> None:
    """Give a dtype its byte order, an array all that it is."""
    if isinstance(built, _Dtype):
        built.dtype = built.dtype.newbyteorder(state[1])
        return
    _version, shape, dtype, fortran, data = state
    if built.size or built.base is not None:
        raise _Refused("an array that changes")
    built.__setstate__((1, shape, _fitting(shape, dtype, data), bool(fortran), data))


def _reconstruct(_kind: object, _shape: object, _code: object) -> Any:
    return np.empty(0, np.int8)


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> Any:
    flat = np.frombuffer(data, _fitting(shape, dtype, data))
    array = flat.reshape(shape, order="F" if order == "F" else "C")
    return array if axes is None else array.transpose(axes)


def _scalar(dtype: Any, data: Any) -> Any:
    if len(data) > _LONGEST:
        raise _Refused(f"a scalar of more than {_LONGEST:,} bytes")
    return np.frombuffer(data, _fitting((), dtype, data))[0].item()


def _fitting(shape: Any, dtype: Any, data: Any) -> "np.dtype[Any]":
    """The dtype, if an array of that shape has as many bytes as the data."""
    plain = isinstance(shape, tuple) and len(shape) <= _MOST_DIMENSIONS
    plain = plain and all(type(n) is int and 0 <= n < 2**63 for n in shape)
    if not plain or not isinstance(dtype, _Dtype) or not isinstance(data, bytes | bytearray):
        raise _Refused("an array whose shape, dtype or data is not plain")
    if prod(shape) * dtype.dtype.itemsize != len(data):
        raise _Refused(f"an array of shape {shown(shape)} in {len(data)} bytes")
    return dtype.dtype


def _latin1(text: str, encoding: Any) -> bytes:
    """How protocol 2 writes bytes."""
    if encoding != "latin1":
        raise _Refused(f"encoding {shown(encoding)}")
    return text.encode("latin1")


def _uncalled(*_: object) -> None:
    """`numpy.ndarray` itself is named in a pickle, never called."""
    raise _Refused("a call of numpy.ndarray")


def _ordered() -> dict[Any, Any]:
    return {}


def _hashed(keys: Any) -> Any:
    """Keys that are no containers, whose hash could take for ever."""
    for key in keys:
        if not isinstance(key, _KEYS):
            raise _Refused(f"a key or a member of a set that is a {type(key).__name__}")
        if getsizeof(key) > _LONGEST:
            raise _Refused(f"a key or a member of a set of more than {_LONGEST:,} bytes")
    return keys


def _set(members: Any) -> set[Any]:
    """A set of members that all differ: comparing those that do not could take for ever."""
    if not isinstance(members, list) or len(made := set(_hashed(members))) < len(members):
        raise _Refused("a set that is not made of a list whose members differ")
    return made


_CALLS: Mapping[str, Callable[..., Any]] = {
    "numpy dtype": _Dtype,
    "numpy ndarray": _uncalled,
    "numpy._core.multiarray _reconstruct": _reconstruct,
    "numpy._core.multiarray scalar": _scalar,
    "numpy._core.numeric _frombuffer": _frombuffer,
    "_codecs encode": _latin1,
    "collections OrderedDict": _ordered,
    "builtins set": _set,
    "builtins frozenset": lambda members: frozenset(_set(members)),
    "builtins bytes": lambda: b"",
}
"""What the names in a pickle stand for."""
_ADMITTED = re.compile(
    r"PROTO|FRAME|STOP|MARK|MEMOIZE|(LONG_)?(BIN)?(PUT|GET)|(STACK_)?GLOBAL|REDUCE|BUILD"
    r"|NONE|NEWTRUE|NEWFALSE|(SHORT_)?(BIN)?(INT|FLOAT|STRING|UNICODE|BYTES)[128]?|LONG1?"
    r"|BYTEARRAY8|(EMPTY_)?(TUPLE|LIST|DICT|SET)[123]?|(APPEND|SETITEM|ADDITEM)S?|FROZENSET"
)
_KEYED = {
    "SETITEM": slice(-2, -1),
    "SETITEMS": slice(None, None, 2),
    "DICT": slice(None, None, 2),
    "ADDITEMS": slice(None),
    "FROZENSET": slice(None),
}
"""By opcode: which values above the mark, or on the stack, are keys or members of a set."""


class _Reader(_Unpickler):
    """The standard library's, that checks each step before it is taken."""

    stack: list[Any]
    metastack: list[list[Any]]
    read: Callable[[int], bytes]
    left = _MOST
    copied = 0

    def __init__(self, file: IO[bytes], size: int) -> None:
        super().__init__(file, encoding="latin1")
        self.most_copied = max(_COPIED, 2 * size)

        def read(count: int) -> bytes:
            if count > size:  # for which Python would make room
                raise EOFError(f"{count:,} bytes of {size:,}")
            return file.read(count)

        self._file_read = read

    def find_class(self, module: str, name: str) -> Any:
        # As numpy 2 and protocol 3 spell them.
        known = f"{module} {name}".replace("numpy.core.", "numpy._core.")
        known = known.replace("__builtin__", "builtins")
        if known not in _CALLS:
            raise _Refused(".".join(shown(part).strip("'") for part in (module, name)))
        return _CALLS[known]

    def build(self) -> None:
        """Give what stands below it the state on top."""
        _build(self.stack[-2], self.stack.pop())

    def bytearray8(self) -> None:
        """Read bytes; Python's own takes as much memory as they say they are."""
        self.stack.append(self.read(unpack("<Q", self.read(8))[0]))


def _guarded(opcode: str, step: Callable[[Any], None]) -> Callable[[Any], None]:
    """A step of the reader, refused where plain data do not need it."""
    admitted = _ADMITTED.fullmatch(opcode)
    keys = _KEYED.get(opcode, slice(0))
    calls = opcode in ("REDUCE", "BUILD")

    def take(reader: _Reader) -> None:
        reader.left -= 1
        if reader.left < 0:
            raise _Refused(f"more than {_MOST:,} steps")
        if not admitted:
            raise _Refused(f"{opcode}, which plain data do not need")
        if opcode.startswith("SETITEM"):
            filled = reader.stack[-3] if opcode == "SETITEM" else reader.metastack[-1][-1]
            if not isinstance(filled, dict):
                raise _Refused(f"a {type(filled).__name__} with keys")
        _hashed(reader.stack[keys])
        step(reader)
        if calls:  # An array that views its bytes is small.
            reader.copied += getsizeof(reader.stack[-1])
            if reader.copied > reader.most_copied:
                raise _Refused(f"copies of more than {reader.most_copied:,} bytes")

    return take


_OWN = {"BUILD": _Reader.build, "BYTEARRAY8": _Reader.bytearray8}
_Reader.dispatch = {
    (code := ord(one.code)): _guarded(one.name, _OWN.get(one.name) or _Unpickler.dispatch[code])
    for one in pickletools.opcodes
}


def _check_plain(value: Any, most: int, depth: int) -> int:
    """How many more values there may be after this one and those in it."""
    if most == 0 or depth > _DEEPEST:
        raise _Refused(
            f"more than {_MOST:,} values, or containers nested more than {_DEEPEST} deep"
        )
    if isinstance(value, dict | list | tuple | set | frozenset):
        for part in value.values() if isinstance(value, dict) else value:
            most = _check_plain(part, most, depth + 1)
    elif isinstance(value, int) and value.bit_length() > 64:
        raise _Refused(shown(value))
    elif not isinstance(value, _PLAIN):
        raise _Refused("a dtype or a name without an array")
    return most - 1


def load_plain(path: Path, most: int) -> Any:
    """What the pickle holds, if it is numpy arrays, scalars, dicts, lists, tuples, sets and text.

    Scalars of numpy become plain numbers. Raises `RecordingError` naming what else it asks for, of
    which nothing is executed, or how it is damaged, or that the file has more than `most` bytes.
    """
    size = RECORDINGS.check_file(path)
    check_limit(path, size, most, "array_bytes", "bytes")
    # Damaged bytes make numpy and the opcodes' readers raise almost any exception.
    with RECORDINGS.foreign(path, "damaged pickle"), path.open("rb") as file:
        try:
            _check_plain(value := _Reader(file, size).load(), _MOST, 0)
            return value
        except _Refused as error:
            raise INTACT.refusal(
                path,
                f"refused: it asks for {error}; only numpy arrays and plain containers are "
                "admitted, because a pickle can run code. Nothing was executed",
            ) from None
