"""The documents of a store, of its arrays and of its episodes, as models.

A store may come from anywhere, so these models check it; the code behind them reads no raw
dictionary.
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
    version: Literal[1] = Field(alias="schema")
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
