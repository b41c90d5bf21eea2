"""The unpickler that runs nothing."""

import _codecs as codecs
import builtins
import io
import os
import pickle
import subprocess
import tempfile
from collections import OrderedDict
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.errors import RecordingError
from pipeline.data.plain_pickle import load_plain as load


def load_plain(path: Path) -> object:
    return load(path, 2**30)


def save(path: Path, content: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


ARRAYS = {
    "float32": np.arange(6, dtype=np.float32).reshape(2, 3),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big-endian": np.arange(3, dtype=">f8"),
    "integers": np.arange(3),
    "booleans": np.array([True, False]),
    "words": np.array(["a", "bc"]),
    "empty": np.zeros((0, 7), np.float32),
    "zero-dimensional": np.array(2.5),
    "view": np.arange(10.0)[::2],
    "turned": np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
}


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_come_back_at_every_protocol(tmp_path, protocol, name):
    array = ARRAYS[name]
    loaded = load_plain(save(tmp_path / "data.pkl", {"a": array}, protocol))["a"]
    assert isinstance(loaded, np.ndarray) and loaded.dtype.kind == array.dtype.kind
    np.testing.assert_array_equal(loaded, array)


@pytest.mark.parametrize("protocol", range(6))
def test_plain_containers_and_scalars_come_back(tmp_path, protocol):
    content = {
        "list": [1, 2.5, None, True, "ü", b"\x00\xff"],
        "tuple": (1, (2,)),
        "set": {1, 2},
        "ordered": OrderedDict(a=1, b=[2]),
        "scalars": [np.float32(1.5), np.int64(7), np.float64(0.1)],
    }
    assert load_plain(save(tmp_path / "data.pkl", content, protocol)) == content


def test_numpy_1_spelling_is_known(tmp_path):
    content = pickle.dumps(np.arange(3.0), protocol=2)
    assert b"numpy._core" in content
    path = tmp_path / "data.pkl"
    path.write_bytes(content.replace(b"numpy._core", b"numpy.core"))
    np.testing.assert_array_equal(load_plain(path), np.arange(3.0))


class Reduced:
    """Pickles as a call of whatever it is given."""

    def __init__(self, call, *arguments) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


def global_call(module: str, name: str, *arguments: object) -> bytes:
    """A protocol-2 pickle that calls `module.name(*arguments)`."""
    body = io.BytesIO()
    pickle._Pickler(body, 2).save(arguments)  # type: ignore[attr-defined]
    return b"\x80\x02c" + f"{module}\n{name}\n".encode() + body.getvalue() + b"R."


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    "call",
    [
        lambda mark: Reduced(os.system, f"touch {mark}"),
        lambda mark: Reduced(subprocess.Popen, ["touch", str(mark)]),
        lambda mark: Reduced(builtins.eval, f"open({str(mark)!r}, 'w')"),
        lambda mark: Reduced(builtins.exec, f"open({str(mark)!r}, 'w')"),
        lambda mark: Reduced(builtins.open, str(mark), "w"),
        lambda mark: Reduced(partial, os.system, f"touch {mark}"),
        lambda mark: Reduced(np.save, str(mark), np.arange(3)),
        lambda mark: Reduced(np.memmap, str(mark), "u1", "w+", 0, (4,)),
        lambda mark: Path(mark),
    ],
)
def test_a_hostile_pickle_is_refused_and_nothing_runs(tmp_path, protocol, call):
    mark = tmp_path / "mark.npy"
    content = {"action": np.zeros((3, 7)), "extra": call(mark)}
    path = save(tmp_path / "data.pkl", content, protocol)
    with pytest.raises(RecordingError, match=r"data\.pkl: refused.*Nothing was executed"):
        load_plain(path)
    assert not list(tmp_path.glob("mark*"))


@pytest.mark.parametrize(
    ("module", "name", "arguments"),
    [
        ("os", "system", ("touch {mark}",)),
        ("posix", "system", ("touch {mark}",)),
        ("nt", "system", ("touch {mark}",)),
        ("builtins", "eval", ("open('{mark}', 'w')",)),
        ("__builtin__", "eval", ("open('{mark}', 'w')",)),
        ("builtins", "__import__", ("os",)),
        ("builtins", "getattr", ("os", "system")),
        ("numpy", "load", ("{mark}",)),
        ("numpy", "f2py.capi_maps.eval", ("1",)),
        ("numpy.testing._private.utils", "runstring", ("open('{mark}', 'w')", {})),
        ("numpy.core._multiarray_umath", "_reconstruct", ()),
        ("numpy._core._multiarray_umath", "fromfile", ("{mark}",)),
        ("numpy._core.multiarray", "fromfile", ("{mark}",)),
        ("numpy._core.multiarray", "_reconstruct.__globals__", ()),
        ("numpy.core.multiarray", "os.system", ("touch {mark}",)),
        ("numpy", "ndarray.tofile", ("{mark}",)),
        ("numpy", "ndarray", ((10**15,),)),
        ("numpy", "dtype", ("O",)),
        ("numpy", "dtype", ([("a", "O")],)),
        ("_codecs", "encode", ("x", "rot13")),
        ("functools", "partial", ()),
        ("collections", "namedtuple", ("a", "b")),
        ("copyreg", "_reconstructor", (1, 2, 3)),
        ("pandas.core.frame", "DataFrame", ()),
    ],
)
def test_names_that_look_innocent_are_refused(tmp_path, module, name, arguments):
    mark = tmp_path / "mark"
    told = [a.format(mark=mark) if isinstance(a, str) else a for a in arguments]
    path = tmp_path / "data.pkl"
    path.write_bytes(global_call(module, name, *told))
    with pytest.raises(RecordingError, match=r"data\.pkl: refused"):
        load_plain(path)
    assert not mark.exists()


def test_an_array_of_objects_is_refused(tmp_path):
    content = np.array([{"a": 1}, None], object)
    with pytest.raises(RecordingError, match=r"refused.*dtype"):
        load_plain(save(tmp_path / "data.pkl", content))


def test_an_array_with_less_data_than_its_shape_is_refused(tmp_path):
    content = pickle.dumps(np.arange(4, dtype=np.int16), protocol=4)
    path = tmp_path / "data.pkl"
    assert content.count(b"K\x04\x85") == 1
    path.write_bytes(content.replace(b"K\x04\x85", b"K\xff\x85"))
    with pytest.raises(RecordingError, match=r"refused.*255"):
        load_plain(path)


def test_what_a_pickle_sets_on_an_admitted_name_does_not_outlive_it(tmp_path):
    path = tmp_path / "data.pkl"
    # (numpy.dtype).__setstate__((None, {"func": 1})), then .keywords and so on.
    path.write_bytes(b"\x80\x02cnumpy\ndtype\n(N}U\x04func\x94K\x01su\x86b.")
    with pytest.raises(RecordingError):
        load_plain(path)
    kept = save(tmp_path / "kept.pkl", np.arange(3.0))
    np.testing.assert_array_equal(load_plain(kept), np.arange(3.0))


@pytest.mark.parametrize("keep", [0, 1, 20, 200, 600])
def test_a_truncated_pickle_is_damaged_and_accused_of_nothing(tmp_path, keep):
    path = save(tmp_path / "data.pkl", {"action": np.arange(100.0)})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError, match=r"data\.pkl: damaged pickle: .*Copy the file again"):
        load_plain(path)


SHARED = b"".join(b"h%ch%c\x86\x94" % (n, n) for n in range(60))
"""Opcodes that put the tuple of memo 0 into a tuple twice, that into another twice, and so on."""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x80\x02N" + b"\x85" * 600_000 + b".", "more than 500,000 steps"),
        (b"\x80\x02N" + b"\x85" * 2000 + b".", "nested more than 20 deep"),
        (b"\x80\x02}(N" + b"2\x86" * 60 + b"Nu.", "DUP, which plain data do not need"),
        (b"\x80\x04}()\x94" + SHARED + b"Nu.", "a key .* that is a tuple"),
        (b"\x80\x04)\x94" + SHARED + b".", "nested more than 20 deep"),
        (b"\x80\x04)\x94" + SHARED[: 6 * 19] + b".", "500,000 values"),
        (b"\x80\x04cnumpy\ndtype\n)\x94" + SHARED + b"\x89\x88\x87R.", "dtype|callable"),
        (b"\x80\x04)\x94" + SHARED + b"Q.", "asks for BINPERSID"),
        (b"\x80\x02U\x05mesh1Q.", "asks for BINPERSID"),
        (b"\x80\x04)\x94" + SHARED + b"h\x01\x93.", "damaged pickle"),
        (b"\x80\x02\x8b\x10\0\0\0" + b"\x01" * 16 + b".", "asks for"),
        (b"\x80\x04]\x94h\0a.", "nested more than 20 deep"),
        (b"\x80\x02ccollections\nOrderedDict\n]](h\0Neh\0a\x85R.", "damaged pickle"),
        (pickle.dumps(np.zeros(2), 2)[:-1] + b"K\0K\1s.", "a ndarray with keys"),
        (b"\x80\x05\x96\0\0\0\0\xff\0\0\0.", "damaged pickle"),
        (b"\x80\x05\x97.", "NEXT_BUFFER"),
        (b"\x80\x04\x8e" + b"\xff" * 7 + b"\x7f.", "damaged pickle"),
        (b"\x80\x02}U\x01acnumpy\ndtype\ns.", "without an array"),
    ],
)
def test_what_would_take_for_ever_is_refused_at_once(tmp_path, content, message):
    path = tmp_path / "data.pkl"
    path.write_bytes(content)
    mend = "Copy the file" if "damaged" in message else "(Write|Copy) the file"
    with pytest.raises(RecordingError, match=rf"data\.pkl: .*{message}.*{mend}") as caught:
        load_plain(path)
    assert len(str(caught.value)) < 600


SWAPPED = np.zeros(2**17, ">f8").__reduce__()


class Again:
    """Pickles as the same call of the same arguments, whose bytes stand in the file once."""

    def __init__(self, *reduced: object) -> None:
        self.reduced = reduced

    def __reduce__(self):
        return self.reduced


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    "reduced",
    [
        (codecs.encode, ("a" * 2**20, "latin1")),
        (set, ([*range(20_000)],)),
        (frozenset, ([*range(20_000)],)),
        SWAPPED,
    ],
)
def test_what_stands_once_is_not_copied_again_and_again(tmp_path, reduced, protocol):
    path = save(tmp_path / "data.pkl", [Again(*reduced) for _ in range(100)], protocol)
    message = r"data\.pkl: refused: it asks for copies of more than 67,108,864 bytes"
    with pytest.raises(RecordingError, match=message):
        load_plain(path)


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("dtype", ["<f8", ">f8"])
def test_an_array_may_be_copied_once_for_its_byte_order(tmp_path, monkeypatch, dtype, protocol):
    monkeypatch.setattr("pipeline.data.plain_pickle._COPIED", 0)
    array = np.arange(99_999.0).astype(dtype)
    loaded = load_plain(save(tmp_path / "data.pkl", [array], protocol))
    np.testing.assert_array_equal(loaded[0], array)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (Again(set, ([1, 1],)), "a set that is not made of a list whose members differ"),
        (Again(set, ((1, 2),)), "a set that is not made of a list whose members differ"),
        (Again(set, (np.zeros(3),)), "a set that is not made of a list whose members differ"),
        ({"a" * 50_000: 1}, "a key or a member of a set of more than 40,000 bytes"),
        (np.str_("a" * 20_000), "a scalar of more than 40,000 bytes"),
        (Again(*SWAPPED[:2], (1, (1,) * 65, np.dtype("i1"), False, b"a")), "shape, dtype or data"),
        (Again(*SWAPPED[:2], (1, (0, 2**63), np.dtype("i1"), False, b"")), "shape, dtype or data"),
    ],
)
def test_what_takes_long_again_and_again_is_refused(tmp_path, content, message):
    path = save(tmp_path / "data.pkl", content, 2 if isinstance(content, Again) else 0)
    with pytest.raises(RecordingError, match=rf"data\.pkl: refused: .*{message}.*Write the file"):
        load_plain(path)


def test_an_index_of_the_memo_costs_nothing(tmp_path):
    path = tmp_path / "data.pkl"
    path.write_bytes(b"K\x00r\xff\xff\xff\x0f.")
    assert load_plain(path) == 0


def test_a_list_that_stands_twice_comes_back(tmp_path):
    twice = [1, 2]
    assert load_plain(save(tmp_path / "data.pkl", {"a": twice, "b": twice})) == {
        "a": twice,
        "b": twice,
    }


PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary()
    | st.floats(width=32, allow_nan=False).map(np.float32),
    lambda inner: (
        st.lists(inner)
        | st.dictionaries(st.text() | st.integers(-9, 9), inner)
        | st.tuples(inner, inner)
        | st.frozensets(st.integers(-9, 9))
    ),
    max_leaves=20,
)


@given(PLAIN, st.integers(0, 5))
def test_it_gives_what_pickle_gives(content, protocol):
    written = pickle.dumps(content, protocol)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.pkl"
        path.write_bytes(written)
        assert load_plain(path) == pickle.loads(written)


def test_random_bytes_never_raise_anything_else(tmp_path):
    rng = np.random.default_rng(0)
    whole = pickle.dumps({"action": np.arange(20.0), "metadata": {"a": [1, 2]}}, protocol=4)
    path = tmp_path / "data.pkl"
    for _ in range(500):
        content = bytearray(whole)
        for place in rng.integers(0, len(content), 3):
            content[place] = rng.integers(0, 256)
        path.write_bytes(bytes(content))
        try:
            load_plain(path)
        except RecordingError as error:
            assert "data.pkl" in str(error)


@pytest.mark.parametrize("opcode", [b"\x95", b"\x8e", b"\x96", b"\x8d"])
def test_a_length_beyond_the_file_takes_no_memory(tmp_path, opcode):
    path = tmp_path / "data.pkl"
    path.write_bytes(b"\x80\x05" + opcode + (2**62).to_bytes(8, "little") + b"N.")
    with pytest.raises(RecordingError, match=r"damaged pickle: (?!not enough memory)"):
        load_plain(path)
