"""What may be done to a file, in tables: by the kind of file, each with what it permits.

Every change draws from the generator that it is given, so that a case is known by its number.
"""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Literal, NamedTuple

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


def _place(rng: Random, document: Any) -> tuple[Any, Any, str]:
    """A random container in a document, a key of it, and the place in words."""
    parent, key, names = None, None, list[str]()
    node = document
    while isinstance(node, dict | list) and node and (parent is None or rng.random() < 0.75):
        key = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
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
    """Something else in the place of a file: nothing, a pipe, another's file."""
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
