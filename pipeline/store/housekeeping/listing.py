"""An inventory as a table for people."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.base.format import size
from pipeline.store.housekeeping.contents import Contents
from pipeline.store.housekeeping.inventory import GROUPS, Entry, Inventory

_HEADS = ("", "what", "on disk", *GROUPS, "episodes", "ticks", "VL rows", "spec")
_BESIDE = ("lock", "ledger")
"""Shown with the store that they lie beside."""


def table(inventory: Inventory, dependents: Mapping[Path, Sequence[str]]) -> list[str]:
    """Sizes and counts, a line each; below each store what depends on it, then the specs.

    `dependents`: store -> what trained policies depend on it, a line each.
    """
    bases = {one.base for one in inventory.entries if one.kind not in _BESIDE}
    things = [one for one in inventory.entries if one.kind not in _BESIDE or one.base not in bases]
    if not things:
        return [f"{inventory.folder}: no store in it"]
    rows = [_HEADS, *(_row(inventory, one) for one in things)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADS))]
    lines = [_aligned(_HEADS, widths)]
    for one, row in zip(things, rows[1:], strict=True):
        lines.append(_aligned(row, widths))
        lines += [f"    {line}" for line in _details(inventory, one, dependents.get(one.path, ()))]
    return [*lines, "", *_specs(things), *_total(inventory)]


def clause(damage: str) -> str:
    """What is wrong, without what to run about it."""
    return damage.split(". ", 1)[0].splitlines()[0]


def _row(inventory: Inventory, entry: Entry) -> tuple[str, ...]:
    name = entry.path.relative_to(inventory.folder).as_posix()
    what = "damaged" if entry.damage else entry.kind
    counts = ("", "", "", "")
    if entry.contents is not None:
        held = entry.contents
        rows = f"{held.rows:,}" if held.done == held.rows else f"{held.done:,} of {held.rows:,}"
        counts = (f"{held.episodes:,}", f"{held.ticks:,}", rows, _short(held.spec))
    return (name, what, size(entry.bytes), *(size(entry.sizes[group]) for group in GROUPS), *counts)


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    cells = [
        cell.ljust(width) if column in (0, 1) else cell.rjust(width)
        for column, (cell, width) in enumerate(zip(row, widths, strict=True))
    ]
    return "  ".join(cells).rstrip()


def _details(inventory: Inventory, entry: Entry, dependents: Iterable[str]) -> Iterator[str]:
    if entry.damage:
        yield f"damaged: {clause(entry.damage)}"
    if entry.contents is not None and entry.kind == "store":
        yield _embodiment(entry.contents)
    if entry.path.is_symlink():
        yield f"a link to {entry.path.resolve()}"
    if entry.kind in ("build", "repair", "set aside", "replaced", "previous"):
        begun = entry.contents is not None or entry.damage is not None
        yield f"belongs to {entry.base.name}{'' if begun else '; of no use unfinished'}"
    holder = inventory.holders.get(entry.base)
    if holder and entry.kind != "archive":
        yield f"being built by {holder}" if entry.kind == "build" else f"locked by {holder}"
    for path, count in inventory.siblings(entry).items():
        yield f"shares {size(count)} with {path.name} by hard links"
    if inventory.linked_elsewhere(entry):
        yield "its files have other names outside this folder, as in a DVC cache"
    if entry.kind == "store":
        yield from (f"archived as {one.path.name}" for one in inventory.archives_of(entry))
        beside = [one for one in inventory.of_kind(*_BESIDE) if one.base == entry.base]
        if beside:
            said = ", ".join(f"{one.path.name} ({size(one.bytes)})" for one in beside)
            yield f"beside it: {said}"
    yield from dependents


def _embodiment(held: Contents) -> str:
    kind = held.attrs["streams"]["action"].get("kind", "")
    rate = "recorded rows" if held.attrs["action_hz"] is None else f"{held.attrs['action_hz']:g} Hz"
    absent = [name for name in ("sensor", "state") if not held.widths[name]]
    there = [f"{name} {width}" for name, width in held.widths.items() if name not in absent]
    there[0] += f" ({kind})" if kind else ""
    sources = ", ".join(held.attrs["sources"])
    return (
        f"{', '.join(there)}{', no ' + ' and '.join(absent) if absent else ''}; {rate}, an answer "
        f"every {held.attrs['vlm_reuse_count']} ticks; sources {sources}"
    )


def _specs(things: Sequence[Entry]) -> Iterator[str]:
    """Each feature spec once, with its main entries."""
    found = {_short(one.contents.spec): one.contents for one in things if one.contents}
    for digest, held in found.items():
        slots, dim, dtype = held.features
        said = [f"{slots} slots x {dim} in {dtype}", f"sensor in {held.sensor_dtype}"]
        spec = held.spec
        said += _read_out(spec)
        for name, place in (
            ("weights", ("weights",)),
            ("adapter", ("adapter",)),
            ("pixels", ("processor", "image_size")),
            ("computed in", ("compute_dtype",)),
            ("variants", ("variants",)),
        ):
            if (value := _at(spec, place)) is not None:
                said.append(f"{name} {_said(value)}")
        if isinstance(prompt := spec.get("prompt"), str):
            said.append(f"prompt {_first_words(prompt)!r}")
        yield f"spec {digest}: {', '.join(said)}"


def _read_out(spec: Mapping[str, Any]) -> list[str]:
    """From which layers and how the slots were pooled: what tells two specs apart at a glance."""
    slots = [one for one in spec.get("slots", ()) if isinstance(one, Mapping)]
    if not slots:
        return []
    kinds = dict.fromkeys((_at(one, ("layer",)), _at(one, ("pooling",))) for one in slots)
    return [" + ".join(f"{pooling} of layer {layer}" for layer, pooling in kinds)]


def _total(inventory: Inventory) -> Iterator[str]:
    apart = sum(one.bytes for one in inventory.entries)
    once = inventory.bytes
    linked = f", {size(apart - once)} of hard links counted once" if apart > once else ""
    yield f"{inventory.folder}: {size(once)} on the disk{linked}"


def _at(document: Any, place: Sequence[str]) -> Any:
    for name in place:
        document = document.get(name) if isinstance(document, Mapping) else None
    return document


def _said(value: Any) -> str:
    if isinstance(value, list):
        return " x ".join(map(str, value))
    return str(value)[:8] if isinstance(value, str) and len(value) == 32 else str(value)


def _short(spec: Mapping[str, Any]) -> str:
    return str(spec.get("digest", "?"))[:8]


def _first_words(prompt: str) -> str:
    return prompt if len(prompt) <= 40 else f"{prompt[:39]}…"
