"""Unpickling that admits numpy arrays and plain containers, and nothing else.

A pickle names callables and runs them. Here a name is looked up in a short table of stand-ins of
our own: no module is imported, no foreign callable reached, and numpy's own `__setstate__` sees
only a checked dtype and as many bytes as the shape needs.
"""

import pickle
import re
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import RecordingError

_DTYPE = re.compile(r"[<>=|]?(\?|[biuf][1248]|[SU]\d{1,6})")


class _Refused(pickle.UnpicklingError):
    """The pickle asks for something that is not admitted; other errors are damage."""


class _Dtype:
    """Stands for `numpy.dtype`: only booleans, numbers and text."""

    def __init__(self, code: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or not _DTYPE.fullmatch(code):
            raise _Refused(f"an array of dtype {code!r}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray[Any, np.dtype[Any]]):
    """Stands for an array until its state has been checked."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, shape, dtype, fortran, data = state
        _check_size(shape, dtype, data)
        checked: Any = (1, shape, dtype.dtype, bool(fortran), data)
        super().__setstate__(checked)


def _reconstruct(_kind: object, _shape: object, _code: object) -> _Array:
    return _Array((0,), np.int8)


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any) -> Any:
    _check_size(shape, dtype, data)
    flat = np.frombuffer(bytes(data), dtype.dtype)
    return flat.reshape(shape, order="F" if order == "F" else "C")


def _scalar(dtype: Any, data: Any) -> Any:
    _check_size((), dtype, data)
    return np.frombuffer(data, dtype.dtype)[0]


def _latin1(text: Any, encoding: Any) -> bytes:
    """How protocol 2 writes bytes."""
    if encoding != "latin1":
        raise _Refused(f"encoding {encoding!r}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """How protocol 2 writes b''."""
    return b""


def _check_size(shape: Any, dtype: Any, data: Any) -> None:
    sized = all(isinstance(n, int) and n >= 0 for n in shape) and isinstance(dtype, _Dtype)
    if not sized or not isinstance(data, bytes | bytearray):
        raise _Refused("an array whose shape, dtype or data is not plain")
    if prod(shape) * dtype.dtype.itemsize != len(data):
        raise _Refused(f"an array of shape {shape} in {len(data)} bytes")


def _uncalled(*_: object) -> None:
    """`numpy.ndarray` itself is named in a pickle, never called."""
    raise _Refused("a call of numpy.ndarray")


_STAND_INS: Mapping[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _uncalled,
    **{
        (f"numpy.{core}.{module}", name): stand_in
        for core in ("core", "_core")
        for module, name, stand_in in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _frombuffer),
        )
    },
    ("_codecs", "encode"): _latin1,
    ("collections", "OrderedDict"): OrderedDict,
    **{
        (builtins, name): stand_in
        for builtins in ("builtins", "__builtin__")
        for name, stand_in in (("set", set), ("frozenset", frozenset), ("bytes", _no_bytes))
    },
}


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        stand_in = _STAND_INS.get((module, name))
        if stand_in is None:
            raise _Refused(f"{module}.{name}")
        # A fresh partial, so that nothing a pickle sets on it outlives this load.
        return partial(stand_in)

    def persistent_load(self, pid: Any) -> Any:
        raise _Refused(f"an object of its program's own, {pid!r}")


def load_plain(path: Path) -> Any:
    """What the pickle holds, if it is numpy arrays, scalars, dicts, lists, tuples, sets and text.

    Raises `RecordingError` naming what else it asks for, of which nothing is executed, or how it is
    damaged.
    """
    try:
        with path.open("rb") as file:
            return _PlainUnpickler(file).load()
    except _Refused as error:
        raise RecordingError(
            f"{path}: refused: it asks for {error}; only numpy arrays and plain containers are "
            "admitted, because a pickle can run code. Nothing was executed"
        ) from None
    # Damaged bytes make the unpickler raise almost any exception (library reference, pickle).
    except Exception as error:
        raise RecordingError(
            f"{path}: damaged pickle: {type(error).__name__}: {error}; copy it again"
        ) from None
