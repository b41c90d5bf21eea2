"""What a store, an array of it and an episode in it say of themselves, read once.

A store may come from anywhere: nothing behind this module asks a dictionary what it holds.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AliasPath, Field

from pipeline.base.border import Border, Document, Text
from pipeline.base.errors import StoreIncomplete
from pipeline.base.source import SlotDocument, SourceDocument, ViewName
from pipeline.store.repair_hints import mend

Length = Annotated[int, Field(ge=0, le=2**48)]


@lru_cache(64)
def store_border(root: Path) -> Border:
    """How what a store or a build says of itself is refused."""
    return Border(StoreIncomplete, mend(root))


class Group(Document):
    """The `zarr.json` of a group."""

    zarr_format: Literal[3]
    node_type: Literal["group"]
    attributes: dict[str, Any] = Field(default_factory=dict)


class ArrayDocument(Document):
    """The `zarr.json` of an array: what decides the rest of it."""

    shape: list[Length]
    data_type: Text
    chunk_rows: Length = Field(
        validation_alias=AliasPath("chunk_grid", "configuration", "chunk_shape", 0)
    )


_Pixels = Annotated[int, Field(ge=1, le=2**13)]


class FrameDocument(Document):
    """The `zarr.json` of a golden frame: one chunk, as long as it is."""

    shape: tuple[_Pixels, _Pixels, Literal[3]]


class EpisodeText(Document):
    """What `episode/text` says of an episode."""

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
    """What a store says of a golden row."""

    row: Length
    prompt: Annotated[str, Field(max_length=10**6)]
    views: list[ViewName]


class StoreAttributes(SourceDocument):
    """The root attributes of a store or a laid-out build."""

    raw: dict[str, Any]
    """All of them, as they stand there."""
    version: Literal[1] = Field(alias="schema")
    plan: Text
    slots: list[SlotDocument]
    sources: Annotated[list[Text], Field(min_length=1)]
    environment: list[_Environment]
    golden: list[StoredGolden] = Field(default_factory=list, max_length=16)
    seal: dict[Text, Annotated[str, Field(pattern="^([0-9a-f]{8})*$")]] | None = None
    """By array, the trailers of its chunk files in order, in hex; None in a build."""

    @classmethod
    def of(
        cls, root: Path, attributes: dict[str, Any], border: Border | None = None
    ) -> "StoreAttributes":
        """Those of the store at `root`. Raises `StoreIncomplete` naming the entry that is wrong."""
        entries = {**attributes, "raw": attributes}
        return (border or store_border(root)).parse(entries, cls, root / "zarr.json")
