"""What may be done to a file, in tables: by the kind of file, each with what it permits.

Every change draws from the generator that it is given, so that a case is known by its number.
"""

import csv
import io
import json
import os
import pickle
import re
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

Permit = Literal["same", "any", "type", "refuse"]
"""What exit 0 may give after a change. `same`: what it gave before. `any`: what stands there now.
`type`: likewise, but nothing may take the strange type for the right one. `refuse`: what it gave
before, which only a file gives that nobody opens."""


@dataclass(frozen=True)
class Change:
    """What was done to which file."""

    what: str
    path: Path
    permits: Permit = "any"
    key: str = ""
    """Its place in a document."""
    sound: bool = False
    """Whether the file is still one of its kind: what it contradicts may be named in its place."""


class Edited(NamedTuple):
    """The new content of a file, and the words of a `Change`."""

    data: bytes
    what: str
    permits: Permit = "any"
    key: str = ""
    sound: bool = True


# --- documents -----------------------------------------------------------------------------------

_LITERALS = (
    'null|true|7|0.5|"seven"|[1]|[]|{"a": 1}|0|-1|2147483648|9223372036854775808|1000000000000|'
    '1.0e+308|1.0e+999|NaN|Infinity|-Infinity|""|"a\\u0000b"|"\\ud800"|"\\ud83d\\ude00"|'
    '"\U0001f600 touch"|"\\u001b[31m\\u0007\\r"|"../../../etc/passwd"|"/etc/passwd"|"{"|'
    '"{episode_index:3000000000d}{chunk_index:3000000000d}"|"{episode_index.__class__.__mro__}"'
)
VALUES = {text: text for text in _LITERALS.split("|")} | {
    "10**400": "1" + "0" * 400,
    "10**5000": "1" + "0" * 5000,
    "a text of 1 MB": '"' + "long " * 200_000 + '"',
    "nested 300 deep": "[" * 300 + "]" * 300,
    "nested 100,000 deep": "[" * 100_000 + "]" * 100_000,
    "objects nested 100,000 deep": '{"a":' * 100_000 + "1" + "}" * 100_000,
    "100,000 numbers": "[" + "1," * 99_999 + "1]",
}
"""What JSON can say, by name."""
_HERE = "@here@"


def edit_document(rng: Random, data: bytes) -> Edited:
    """A document of JSON with something wrong at a random place."""
    document = json.loads(data)
    parent, key, where = _place(rng, document)
    name = rng.choice(list(VALUES))
    if parent is None:
        return Edited(_encoded(VALUES[name]), f"the whole is {name}", "type", sound=False)
    permits = "any"
    match rng.choice(["value"] * 6 + ["drop", "unknown"]):
        case "value":
            permits, what = _permits(parent[key], VALUES[name]), f"is {name}"
            parent[key] = _HERE
        case "drop":
            del parent[key]
            what = "is dropped"
        case _ if isinstance(parent, dict):
            parent["zz_nobody_knows"] = rng.choice([1, "x", [2], {"deep": {"er": None}}])
            permits, what = "same", "has an unknown neighbour"
        case _:
            parent.insert(0, parent[key])
            what = "is there once more"
    text = json.dumps(document).replace(f'"{_HERE}"', VALUES[name])
    return Edited(_encoded(text), f"{where} {what}", permits, where, permits != "type")


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _key(rng: Random, node: Any) -> Any:
    return rng.choice(list(node) if isinstance(node, dict) else range(len(node)))


def _place(rng: Random, document: Any) -> tuple[Any, Any, str]:
    """A random container in a document, a key of it, and the place in words."""
    parent, key, names = None, None, list[str]()
    node = document
    while isinstance(node, dict | list) and node and (parent is None or rng.random() < 0.75):
        key = _key(rng, node)
        parent, node = node, node[key]
        names.append(str(key))
    return parent, key, ".".join(names)[:200]


def _permits(old: Any, new: str) -> Permit:
    """`any` where the value is of the old one's type, or says that there is none."""
    try:
        value = json.loads(new)
    except (ValueError, RecursionError):
        return "type"
    numbers = (int, float)
    alike = type(value) is type(old) or (type(value) in numbers and type(old) in numbers)
    return "any" if value is None or old is None or alike else "type"


def edit_lines(rng: Random, data: bytes) -> Edited:
    """A wrong value in a line of JSON, or a line that is missing or doubled."""
    lines = data.splitlines()
    number = rng.randrange(len(lines))
    act = rng.choice(["value"] * 6 + ["dropped", "there twice"])
    edited = Edited(b"", f"line {number + 1} is {act}")
    if act == "value":
        edited = edit_document(rng, lines[number])
        edited = edited._replace(what=f"line {number + 1}, {edited.what}")
    times = {"dropped": 0, "there twice": 2}.get(act, 1)
    lines[number : number + 1] = [edited.data or lines[number]] * times
    return edited._replace(data=b"\n".join(lines) + b"\n")


def edit_safetensors(rng: Random, data: bytes) -> Edited:
    """A wrong value in the header."""
    length = struct.unpack("<Q", data[:8])[0]
    edited = edit_document(rng, data[8 : 8 + length])
    header = struct.pack("<Q", len(edited.data)) + edited.data
    return edited._replace(data=header + data[8 + length :], what=f"header: {edited.what}")


# --- tables and arrays ---------------------------------------------------------------------------

CELLS = ("", " ", "nan", "inf", "1e999", "abc", "1_0", "0x10", "9" * 400, "١٢", '"', "1;2", "-0")


def edit_csv(rng: Random, data: bytes) -> Edited:
    """A wrong cell, or a column or line too many or too few."""
    rows = list(csv.reader(io.StringIO(data.decode())))
    line, column = rng.randrange(1, len(rows)), rng.randrange(len(rows[0]))
    what = f"line {line + 1}, column {rows[0][column]}: "
    match rng.choice(["cell"] * 5 + ["no column", "no line", "order", "cut"]):
        case "cell":
            rows[line][column] = rng.choice([*CELLS, "x" * 200_000])
            what += f"the cell is {rows[line][column][:20]!r}"
        case "no column":
            rows = [row[:column] + row[column + 1 :] for row in rows]
            what += "no such column"
        case "no line":
            del rows[line]
            what += "no such line"
        case "order":
            rows.insert(1, rows.pop(line))
            what += "the line comes first"
        case _:
            del rows[line][column:]
            what += "the line is cut off"
    return Edited("".join(",".join(row) + "\n" for row in rows).encode(), what)


def _last(array: np.ndarray, value: object) -> np.ndarray:
    changed = array.copy()
    changed.reshape(-1)[-1] = value
    return changed


_TYPES = ["c8", "U8", "S8", "?", "M8[s]", "O", "f2", "i8", "u1", "g", ">f8", "f4"]
ARRAYS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "no row": lambda a: a[:0],
    "a row less": lambda a: a[:-1],
    "a single number": lambda a: a.reshape(-1)[0],
    "an axis more": lambda a: a[None],
    "transposed": lambda a: a.T,
    "flat": lambda a: a.reshape(-1),
    "backwards": lambda a: a[::-1],
    "NaN": lambda a: _last(a, np.nan),
    "infinity": lambda a: _last(a, np.inf),
    "1e300": lambda a: _last(a.astype(np.float64), 1e300),
    "records": lambda a: np.zeros(len(a), [("a", "f4"), ("b", "i4")]),
    "Fortran's order": np.asfortranarray,
} | {f"of {t}": lambda a, t=t: a.astype(t) for t in _TYPES}


def _other_array(rng: Random, array: np.ndarray) -> tuple[np.ndarray, str]:
    name = rng.choice(list(ARRAYS))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            return ARRAYS[name](array), f"is {name}"
        except (ValueError, TypeError):  # words are no numbers
            return np.zeros(3), "is three zeros"


def edit_npz(rng: Random, data: bytes) -> Edited:
    """A member of another shape, type or content, or one too many or too few."""
    with np.load(io.BytesIO(data)) as archive:
        members = dict(archive)
    name, permits, buffer = rng.choice(list(members)), "any", io.BytesIO()
    match rng.choice(["array"] * 6 + ["drop", "more"]):
        case "array":
            members[name], what = _other_array(rng, members[name])
        case "drop":
            del members[name]
            what = "is dropped"
        case _:
            members["nobody_knows"], permits = np.array([{}], object), "same"
            what = "has an unknown neighbour of objects"
    np.savez(buffer, **members)
    return Edited(buffer.getvalue(), f"member {name!r} {what}", permits, name)


def edit_pickle(rng: Random, data: bytes) -> Edited:
    """Another value at a place of a pickled document, or another protocol."""
    document: Any = pickle.loads(data)
    parent, key, where = _place(rng, document)
    while isinstance(parent, list) and rng.random() < 0.7:  # most places are paths of frames
        parent, key, where = _place(rng, document)
    protocol, permits = rng.randrange(6), "any"
    what = f"and all in protocol {protocol}"
    act = rng.choice(["value"] * 6 + ["protocol", "drop"])
    if act == "drop":
        del parent[key]
        what = "is dropped"
    elif act == "protocol":
        permits = "same"
    elif isinstance(parent[key], np.ndarray):
        parent[key], what = _other_array(rng, parent[key])
    else:  # no number of thousands of digits, and nothing nested deeper than a pickler goes
        name = rng.choice([name for name in VALUES if not re.search("00 deep|5000", name)])
        permits, what = _permits(parent[key], VALUES[name]), f"is {name}"
        parent[key] = json.loads(VALUES[name])
    return Edited(pickle.dumps(document, protocol), f"{where} {what}", permits, where)


CONSTANTS = (None, True, -1, 10**12, 0.5, 1e300, float("nan"), float("inf"), "", "7")
CONSTANTS += ("../../../etc/passwd", "a\0b", b"\xff\xfe", [[1.0]], [], {"a": 1})
"""What a column of a table may hold, everywhere or in its last row."""


def edit_parquet(rng: Random, data: bytes) -> Edited:
    """A column of other types or values, rows too many or too few, a footer that lies."""
    table: pa.Table = pq.read_table(io.BytesIO(data))
    names = table.column_names
    name = rng.choice([name for name in names if not name.startswith("stats/")])
    rows, wrong = table[name].to_pylist(), rng.choice(CONSTANTS)
    images = ["image"] * 20 * isinstance(table[name].type, pa.StructType)
    match rng.choice(
        images + ["all"] * 4 + ["last"] * 3 + ["drop", "twin", "rows", "row", "order"]
    ):
        case "image":
            edited = edit_image(rng, rows[-1]["bytes"])
            table = with_column(table, name, [*rows[:-1], rows[-1] | {"bytes": edited.data}])
            what = f"the last image of {name!r} {edited.what}"
        case "all":
            table = with_column(table, name, [wrong] * len(rows))
            what = f"column {name!r} is of {wrong!r}"
        case "last":
            if isinstance(rows[-1], list):
                wrong = rng.choice([[wrong] * len(rows[-1]), rows[-1] * 2])
            table = with_column(table, name, [*rows[:-1], wrong])
            what = f"column {name!r} ends with {wrong!r:.99}"
        case "drop":
            table, what = table.drop_columns([name]), f"column {name!r} is dropped"
        case "twin":
            table = pa.Table.from_arrays([*table.columns, table[name]], names=[*names, name])
            what = f"column {name!r} is there twice"
        case "rows":
            table, what = pa.concat_tables([table, table]), "all rows are there twice"
        case "row":
            table, what = table.slice(1), "the first row is dropped"
        case _:
            table, what = table.take(list(range(len(rows)))[::-1]), "rows are backwards"
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return Edited(buffer.getvalue(), what, key=name)


def with_column(table: pa.Table, name: str, rows: list[Any]) -> pa.Table:
    try:
        column = pa.array(rows)
    except (pa.ArrowException, TypeError):
        column = pa.array([str(row) for row in rows])
    return table.set_column(table.column_names.index(name), name, column)


IMAGES = ("GIF", "BMP", "TIFF", "WEBP", "PDF", "PNG", "JPEG")


def edit_image(rng: Random, data: bytes) -> Edited:
    """Another size in a JPEG's header, or an image of another format or mode."""
    kind = rng.choice(["size", *IMAGES, "L", "CMYK"])
    if kind == "size" and data.startswith(b"\xff\xd8"):
        size = rng.choice([(0, 0), (65500, 65500), (12500, 12500), (1, 1)])
        return Edited(resized(data, *size), f"says to have {size} pixels")
    picture, buffer = Image.open(io.BytesIO(data)).convert("RGB"), io.BytesIO()
    if kind in IMAGES:
        picture.save(buffer, kind)
    else:
        picture.convert("RGB" if kind == "size" else kind).save(buffer, "JPEG")
    return Edited(buffer.getvalue(), f"is {kind}")


def resized(data: bytes, height: int, width: int) -> bytes:
    """A JPEG whose header says another size."""
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


# --- bytes of any file ---------------------------------------------------------------------------


def _flipped(rng: Random, data: bytes, times: int) -> bytes:
    changed = bytearray(data)
    for _ in range(times if data else 0):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _inserted(rng: Random, data: bytes, what: bytes) -> bytes:
    at = rng.randrange(len(data) or 1)
    return data[:at] + what + data[at:]


Edit = Callable[[Random, bytes], bytes]
BYTES: dict[str, Edit] = {
    "cut off": lambda rng, data: data[: rng.randrange(len(data) or 1)],
    "empty": lambda rng, data: b"",
    "a bit flipped": lambda rng, data: _flipped(rng, data, 1),
    "ten bits flipped": lambda rng, data: _flipped(rng, data, 10),
    "grown by zeros": lambda rng, data: data + bytes(rng.choice([1, 4096])),
    "noise": lambda rng, data: rng.randbytes(min(len(data), 5000)),
    "a Git LFS pointer": lambda rng, data: b"version https://git-lfs.github.com/spec/v1\n",
}
TEXT: dict[str, Edit] = {
    "with a byte order mark": lambda rng, data: b"\xef\xbb\xbf" + data,
    "in UTF-16": lambda rng, data: data.decode().encode("utf-16"),
    "with a byte that is no UTF-8": lambda rng, data: _inserted(rng, data, b"\xe9"),
    "with Windows' line ends": lambda rng, data: data.replace(b"\n", b"\r\n"),
    "with empty lines at its end": lambda rng, data: data + b"\n\n",
}
HARMLESS = ("with Windows' line ends", "with empty lines at its end")

# --- files as such -------------------------------------------------------------------------------

FILES: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a folder": lambda path: path.mkdir(),
    "a pipe": os.mkfifo,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to its folder": lambda path: path.symlink_to("."),
}


def change_file(rng: Random, path: Path, others: list[Path]) -> Change:
    """Something else in the place of a file: nothing, a pipe, another's file, a strange name."""
    name = rng.choice([*FILES, "of another"])
    if name == "of another" and others:
        other = rng.choice(others)
        rewrite(path, other.read_bytes())
        return Change(f"the content of {other.parent.name}/{other.name}", path, sound=True)
    name = name if name in FILES else "missing"
    path.unlink()
    FILES[name](path)
    gone = name in ("missing", "a link to nothing", "a link to itself")
    return Change(name, path, "any" if gone else "refuse", sound=gone)


KINDS: dict[str, Callable[[Random, bytes], Edited]] = {
    ".json": edit_document,
    ".jsonl": edit_lines,
    ".csv": edit_csv,
    ".npz": edit_npz,
    ".pkl": edit_pickle,
    ".parquet": edit_parquet,
    ".safetensors": edit_safetensors,
    ".jpg": edit_image,
}


def change_any(rng: Random, root: Path, other: Path) -> Change:
    """Something wrong with one file at or below `root`; `other` is another of the same making."""
    # Each kind of file is as likely as any other, for frames would crowd out the rest.
    kinds: dict[tuple[str, int], list[Path]] = {}
    files = [root] if root.is_file() else sorted(p for p in root.rglob("*") if p.is_file())
    for path in files:
        kinds.setdefault((path.suffix, len(path.relative_to(root).parts)), []).append(path)
    path = rng.choice(kinds[rng.choice(sorted(kinds))])
    act = rng.choice(["kind"] * 5 + ["bytes"] * 3 + ["file"] * 2)
    if act == "kind" and path.suffix in KINDS:
        data, *words = KINDS[path.suffix](rng, path.read_bytes())
        rewrite(path, data)
        return Change(words[0], path, *words[1:])
    if act == "file" and root.is_dir():
        siblings = [file for file in files if file.suffix == path.suffix and file != path]
        twin = other / path.relative_to(root)
        twins = [twin] * max(1, len(siblings)) if twin.is_file() else []
        return change_file(rng, path, siblings + twins or [path])
    text = path.suffix in (".json", ".jsonl", ".csv", ".txt")
    edits = BYTES | TEXT if text else BYTES
    name = rng.choice(list(edits))
    rewrite(path, edits[name](rng, path.read_bytes()))
    return Change(name, path, "same" if name in HARMLESS else "any")


def rewrite(path: Path, data: bytes) -> None:
    """New content for a file that may be a link into the corpus."""
    path.unlink()
    path.write_bytes(data)
