"""The places where two JSON documents differ, for specs, sources and checkpoints."""

import json
from collections.abc import Mapping
from typing import Any

Differences = dict[str, tuple[Any, Any]]
"""Dotted place -> (expected, actual); None where absent."""


def differences(expected: Any, actual: Any, place: str = "") -> Differences:
    """The places where two JSON documents differ, in the order of the first.

    Two mappings with equal `digest` are equal. If their digests differ, the result has the entries
    that differ, and the digest only if all entries agree. Two lists of mappings of equal length are
    compared entry by entry, other lists as a whole.
    """
    if isinstance(expected, Mapping) and isinstance(actual, Mapping):
        if "digest" in expected and expected["digest"] == actual.get("digest"):
            return {}
        keys = [*expected, *(key for key in actual if key not in expected)]
        inside = {
            key: differences(expected.get(key), actual.get(key), f"{place}.{key}".lstrip("."))
            for key in keys
        }
        digest = inside.pop("digest", {})
        return {place: pair for part in inside.values() for place, pair in part.items()} or digest
    expected = list(expected) if isinstance(expected, tuple) else expected
    actual = list(actual) if isinstance(actual, tuple) else actual
    if expected == actual:
        return {}
    if isinstance(expected, list) and isinstance(actual, list) and len(expected) == len(actual):
        pairs = list(zip(expected, actual, strict=True))
        if all(isinstance(a, Mapping) and isinstance(b, Mapping) for a, b in pairs):
            return {
                where: pair
                for index, (a, b) in enumerate(pairs)
                for where, pair in differences(a, b, f"{place}[{index}]").items()
            }
    return {place: (expected, actual)}


def describe(differing: Differences, arrow: str = " -> ") -> list[str]:
    """A line for each place, `prompt: "x" -> "y"`; long values are cut around their difference.

    For two lists of mappings of different length, a line says how many entries they have.
    """
    return [f"{place}: {_short(a, b)}{arrow}{_short(b, a)}" for place, (a, b) in differing.items()]


def _short(value: Any, other: Any, most: int = 80) -> str:
    # Lists of equal length are compared by entry, so these differ in length.
    if isinstance(value, list) and any(isinstance(entry, Mapping) for entry in value):
        return f"{len(value)} entries"
    text, other_text = (json.dumps(side, ensure_ascii=False) for side in (value, other))
    if len(text) <= most:
        return text
    same = next((at for at, (a, b) in enumerate(zip(text, other_text, strict=False)) if a != b), 0)
    begin = max(0, min(same - 25, len(text) - most))
    end = begin + most
    return f"{'…' if begin else ''}{text[begin:end]}{'…' if end < len(text) else ''}"
