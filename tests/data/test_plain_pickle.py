"""The unpickler that runs nothing."""

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
from pipeline.data.plain_pickle import load_plain as load

from pipeline.base.errors import RecordingError


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
    with pytest.raises(RecordingError, match=r"damaged pickle: .*buffer size does not match"):
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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x80\x02N" + b"\x85" * 2000 + b".", "damaged pickle: RecursionError"),
        (b"\x80\x04]\x94h\0a.", "damaged pickle: RecursionError"),
        (b"\x80\x02U\x05mesh1Q.", "damaged pickle: UnpicklingError"),
        (b"\x80\x02\x82\x01.", "damaged pickle: ValueError"),
        (b"\x80\x05\x97.", "damaged pickle: UnpicklingError"),
        (global_call("numpy", "ndarray", (10**15,)), "damaged pickle: TypeError"),
        (b"\x80\x02}U\x01acnumpy\ndtype\ns.", "a dtype or a name without an array"),
        (b"\x80\x02}cnumpy\ndtype\nNs.", "a dtype or a name without an array"),
        (pickle.dumps(np.zeros(2), 2)[:-1] + b"K\0U\1xs.", "damaged pickle: ValueError"),
    ],
)
def test_what_is_no_data_is_refused(tmp_path, content, message):
    path = tmp_path / "data.pkl"
    path.write_bytes(content)
    mend = "Copy the file" if "damaged" in message else "Write the file"
    with pytest.raises(RecordingError, match=rf"data\.pkl: .*{message}.*{mend}") as caught:
        load_plain(path)
    assert len(str(caught.value)) < 600


def test_memory_of_another_array_is_not_shared(tmp_path):
    """So that no state given to the other array later can free it."""
    numeric = "numpy.core.numeric"
    path = tmp_path / "data.pkl"
    path.write_bytes(global_call(numeric, "_frombuffer", np.zeros(3), np.dtype("f8"), (3,), "C"))
    with pytest.raises(RecordingError, match=r"refused.*shares the memory of another"):
        load_plain(path)


def test_a_file_above_the_limit_is_not_read(tmp_path):
    path = save(tmp_path / "data.pkl", np.zeros(1000))
    with pytest.raises(RecordingError, match=r"data\.pkl: .*limits\.array_bytes"):
        load(path, 1000)


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


@pytest.mark.parametrize("content", [{10**5000: 1}, {"action": -(2**70)}])
def test_no_integer_is_longer_than_64_bits(tmp_path, content):
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(RecordingError, match="an integer of more than 64 bits"):
        load(path, 2**30)
    path.write_bytes(pickle.dumps([2**64 - 1, -(2**63)]))
    assert load(path, 2**30) == [2**64 - 1, -(2**63)]


def test_lists_that_a_few_bytes_name_a_million_times_are_refused(tmp_path):
    nested: object = [0]
    for _ in range(30):
        nested = [nested, nested]
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps({"action": nested}))
    with pytest.raises(RecordingError, match="the same lists again and again"):
        load(path, 2**30)
    shared = ["a.jpg"] * 1000
    path.write_bytes(pickle.dumps({"left": shared, "right": shared}))
    assert load(path, 2**30) == {"left": shared, "right": shared}
