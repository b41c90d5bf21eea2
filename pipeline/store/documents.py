"""The documents of a store, of its arrays and of its episodes as models, and what mends a store.

A store may come from anywhere, so these models check it; the code behind them reads no raw
dictionary. A message about a damaged store ends with the full command to run. It names that store,
which may be another than that of params.yaml.
"""

import re
import shlex
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AliasPath, Field

from pipeline.base.config import setting
from pipeline.base.documents import Border, Document, Text
from pipeline.base.errors import StoreIncomplete
from pipeline.base.printed_commands import command
from pipeline.base.provenance import SlotDocument, SourceDocument, ViewName

Length = Annotated[int, Field(ge=0, le=2**48)]
KNOWN = ".known"
"""The folder within a part for an interrupted build of another plan."""
_STORE = re.compile(r"(?P<base>.+?\.zarr)(?:\.part|\.previous)?")


def extract_command(store: Path) -> str:
    """The command that makes a store or completes its build."""
    return command("extract", setting("extract.store", store))


def gc_command(path: Path) -> str:
    """The command that removes an unfinished build."""
    return command("store", "gc", shlex.quote(str(path)), "--remove")


def restore_command(archive: Path) -> str:
    """The command that restores a store from an archive."""
    return command("archive", "--restore", setting("archive.output", archive))


def mend(path: Path) -> str:
    """What to do about a damaged store or build; `path` is its folder or a file in it."""
    folder, store = _owner(path)
    if folder != store:
        return f"Remove it with {gc_command(folder)}, then run {extract_command(store)}."
    repair = command("verify", "--repair", setting("verify.store", store))
    return f"Run {repair}, which keeps what is sound."


def start_over(path: Path) -> str:
    """What to do where a store's or build's root metadata no longer say what it was made of."""
    folder, store = _owner(path)
    if folder != store:
        return mend(path)
    return (
        f"Nothing can be taken from it without them. Remove or rename {store}, then run "
        f"{extract_command(store)}, or {command('archive', '--restore')}."
    )


def _owner(path: Path) -> tuple[Path, Path]:
    """The store or build at or around a path, and the store's final path."""
    for folder in (path, *path.parents):
        if match := _STORE.fullmatch(folder.name):
            return folder, folder.with_name(match["base"])
    return path, path


@lru_cache(64)
def store_border(root: Path) -> Border:
    """Refuses broken documents of a store or a build."""
    return Border(StoreIncomplete, mend(root))


class Group(Document):
    """The `zarr.json` of a group."""

    zarr_format: Literal[3]
    node_type: Literal["group"]
    attributes: dict[str, Any] = Field(default_factory=dict)


class ArrayDocument(Document):
    """The entries of an array's `zarr.json` that determine all others."""

    shape: list[Length]
    data_type: Text
    chunk_rows: Length = Field(
        validation_alias=AliasPath("chunk_grid", "configuration", "chunk_shape", 0)
    )


_Pixels = Annotated[int, Field(ge=1, le=2**13)]


class FrameDocument(Document):
    """The `zarr.json` of a golden frame, which is stored as one chunk."""

    shape: tuple[_Pixels, _Pixels, Literal[3]]


class EpisodeText(Document):
    """The text of an episode in `episode/text`."""

    id: Text
    path: Text
    format: Text
    instruction: Text
    content: Text
    digest: Text
    group: Text | None = None


class _Environment(Document):
    rows: Annotated[list[Length], Field(min_length=2, max_length=2)]


class StoredGolden(Document):
    """A golden row in the root attributes."""

    row: Length
    prompt: Annotated[str, Field(max_length=10**6)]
    views: list[ViewName]


class StoreAttributes(SourceDocument):
    """The root attributes of a store or a laid-out build; `raw` has all of them, unchanged.

    `seal` has, for each array, the trailers of its chunk files in order, in hex; a build has none
    yet.
    """

    raw: dict[str, Any]
    version: Literal[1, 2] = Field(alias="schema")
    plan: Text
    slots: list[SlotDocument]
    sources: Annotated[list[Text], Field(min_length=1)]
    environment: list[_Environment]
    golden: list[StoredGolden] = Field(default_factory=list, max_length=16)
    seal: dict[Text, Annotated[str, Field(pattern="^([0-9a-f]{8})*$")]] | None = None

    @classmethod
    def of(
        cls, root: Path, attributes: dict[str, Any], border: Border | None = None
    ) -> "StoreAttributes":
        """Parse those of the store at `root`; raises `StoreIncomplete`, which names the entry."""
        entries = {**attributes, "raw": attributes}
        return (border or store_border(root)).parse(entries, cls, root / "zarr.json")
