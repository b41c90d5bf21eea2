"""The three places of a store, and the steps that take a build from one to the next.

    <name>.zarr            the finished store, never modified
    <name>.zarr.part       the build; `.known` in it is an interrupted build of another plan, which
                           may have a `.known` of its own
    <name>.zarr.previous   the replaced store, kept and marked, where it has other rows

A process that changes one of them must hold `<name>.zarr.lock` and call `recover` first. A part
goes through these states. Known rows come from the store, the previous one, a part with a plan and
its `.known`:

    begin_build      finish_layout        finish          put_in_place
    ──────────► bare ────────────► laid out ─────► sealed ────────────► <name>.zarr
                 ▲   (the plan is  │  ▲  │ rows are committed, batch by batch
                 │    the last     │  └──┘
                 │    thing)       │
                 └─────────────────┘ set_build_aside: another plan begins

A kill leaves:
- a bare part: the next build empties it; `.known` stays.
- a laid-out part: the same plan continues it, another plan sets it aside.
- half of `set_build_aside`: `recover` completes it.
- a sealed part without a store: the old store is in `.replaced` of that part (`recover` brings it
  back) or, if it is kept, is the previous one; a run of the same plan only renames the part.
- a new store with `.known` or `.replaced` still in it: `recover` removes these.
"""

import os
from pathlib import Path
from typing import Any

from pipeline.base import files
from pipeline.base.documents import Border, shown
from pipeline.base.errors import ConfigError, StoreIncomplete, StoreMismatch
from pipeline.base.files import (
    OutputKind,
    begin_folder,
    described,
    mark,
    refuse_foreign,
    remove_folder,
    there,
    unmark,
)
from pipeline.store.documents import (
    KNOWN,
    Group,
    StoreAttributes,
    extract_command,
    mend,
    restore_command,
    start_over,
)
from pipeline.store.schema import READABLE

MERGED = "merge-"
"""Prefix of the plan of a store that was merged, not extracted."""


def part_path(target: Path) -> Path:
    """Where a store is built."""
    return target.with_name(target.name + ".part")


def previous_path(target: Path) -> Path:
    """Where the replaced store is kept."""
    return target.with_name(target.name + ".previous")


def is_store(path: Path) -> bool:
    """Whether a store of this project, or a laid-out build of one, lies at `path`."""
    attributes = group_attributes(path)
    return "schema" in attributes and bool({"plan", "feature_spec"} & attributes.keys())


STORE = OutputKind("a feature store", is_store)
KEPT = OutputKind("a store of before, kept for its rows,")
"""The previous store, known by its marker; a user's copy has no marker.

The name must not change: markers of earlier versions contain it.
"""


def refuse_foreign_store(target: Path) -> None:
    """Raise `ConfigError` where something foreign lies in a store's place or its build's.

    A build may not lie behind a link either, because a build is renamed to the store, which works
    only on one file system.
    """
    for place in (target, part_path(target)):
        refuse_foreign(place, STORE)
    if (part := part_path(target)).is_symlink():
        raise ConfigError(
            f"{part}: expected the unfinished build itself, found a link to "
            f"{os.path.realpath(part)}. Move it back, or move the whole folder {target.parent} to "
            "the larger disk and link that."
        )


def recover(target: Path) -> None:
    """Complete or undo the step that a kill stopped, before anything is written.

    Raises `ConfigError` where something lies there that this project did not write.
    """
    refuse_foreign_store(target)
    part = part_path(target)
    if KEPT.marks(target):
        unmark(target)
    files.recover(part, target, STORE)
    remove_folder(target / KNOWN, STORE)
    if KEPT.marks(previous := previous_path(target)) and not (previous / "zarr.json").exists():
        remove_folder(previous, KEPT)  # its removal was stopped
    if there(fresh := _fresh_path(target)):
        if there(fresh / KNOWN):
            fresh.rename(part)
        else:
            remove_folder(fresh, STORE)


def begin_build(target: Path) -> None:
    """Make an empty part and remove an older one; builds that were set aside stay."""
    begin_folder(part_path(target), STORE, but=KNOWN)


def set_build_aside(target: Path) -> None:
    """Move the build into `.known` of a new part, where its rows stay known."""
    part, fresh = part_path(target), _fresh_path(target)
    begin_folder(fresh, STORE)
    part.rename(fresh / KNOWN)
    fresh.rename(part)


def builds_aside(target: Path) -> list[Path]:
    """The builds that were set aside, the last one first."""
    builds: list[Path] = []
    folder = part_path(target) / KNOWN
    while folder.is_dir():
        if is_store(folder):
            builds.append(folder)
        folder = folder / KNOWN
    return builds


def unfinished_plans(target: Path) -> list[str]:
    """The plans of the build and of those that were set aside."""
    plans = (read_plan(place) for place in (part_path(target), *builds_aside(target)))
    return [plan for plan in plans if plan is not None]


def put_in_place(target: Path, keep: bool = False) -> None:
    """Rename a sealed part to the store; remove the old store, or `keep` it as the previous one.

    If the old store is a symbolic link, only the link is removed. Raises `ConfigError` where
    something foreign lies in one of the places.
    """
    if keep and target.is_dir() and not target.is_symlink():
        previous = previous_path(target)
        refuse_foreign(previous, KEPT)
        mark(target, KEPT)  # before the older one is removed: a full disk may refuse this
        remove_folder(previous, KEPT)
        target.rename(previous)
    files.put_in_place(part_path(target), target, STORE)
    remove_folder(target / KNOWN, STORE)


def _fresh_path(target: Path) -> Path:
    """Where a new part is for the moment in which the older one moves into it."""
    return target.with_name(target.name + ".part.new")


def read_plan(store: Path) -> str | None:
    """The plan of a store or a laid-out build; None where there is neither.

    Raises `StoreIncomplete` where a store or build has lost its plan.
    """
    plan = group_attributes(store).get("plan")
    if not isinstance(plan, str) and is_store(store):
        raise StoreIncomplete(
            f"{store / 'zarr.json'}: the metadata no longer say what the store was made of. "
            f"{start_over(store)}"
        )
    return plan if isinstance(plan, str) else None


def read_attributes(root: Path) -> StoreAttributes:
    """The root attributes of a finished store.

    Raises `StoreIncomplete` where one is missing or wrong, and what `find_attributes` does.
    """
    return StoreAttributes.of(root, find_attributes(root))


def laid_out_attributes(root: Path) -> StoreAttributes:
    """The root attributes of a store or a laid-out build at any path."""
    return StoreAttributes.of(root, group_attributes(root))


def find_attributes(root: Path) -> dict[str, Any]:
    """The root attributes of a finished store, unchecked.

    Raises `StoreIncomplete` where there is no store, only a build of it, a store without
    attributes, or something else, and `StoreMismatch` where it has another schema or is an archive.
    """
    build = root.name.endswith(".part")  # its metadata look like a store's
    attributes = {} if build else group_attributes(root)
    if "archive" in attributes:
        raise StoreMismatch(
            f"{root}: expected a store, found an archive of one. Restore it first: "
            f"{restore_command(root)}"
        )
    if "schema" not in attributes:
        target = root.with_name(root.name.removesuffix(".part"))
        actual, then = "nothing there", f"Run {extract_command(target)}."
        if (part := part_path(target)).exists():
            actual = f"only the unfinished build {part}"
        elif there(root):
            actual, then = f"{described(root)} and no zarr.json that says so", mend(root)
        raise StoreIncomplete(f"{root}: no finished store, found {actual}. {then}")
    if attributes["schema"] not in READABLE:
        raise StoreMismatch(
            f"{root / 'zarr.json'}: expected store schema {' or '.join(map(str, READABLE))}, found "
            f"{shown(attributes['schema'])}. Extract it again with this version."
        )
    return attributes


def group_attributes(path: Path) -> dict[str, Any]:
    """The attributes of the zarr group at `path`; empty where there is no group.

    Raises `StoreIncomplete` where its metadata cannot be read.
    """
    if not (path / "zarr.json").exists():
        return {}
    return Border(StoreIncomplete, start_over(path)).read_json(path / "zarr.json", Group).attributes
