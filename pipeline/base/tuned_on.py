"""The episodes that a model was tuned on, beside its weights and in stores of its features."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, Strict, model_validator

from pipeline.base.border import Border, Document, Text
from pipeline.base.errors import StoreIncomplete
from pipeline.base.files import read_document, write_with_digest

TUNED_ON = "tuned_on.json"
"""The file in the folder of an adapter or a tuned checkpoint; not part of its digest."""
_ATTRIBUTE = "tuned_on"
"""The attribute of a store whose model has such a file."""
_STORE = Border(StoreIncomplete, "Copy the store again, or extract it anew with stages.extract.")

Tick = Annotated[int, Field(ge=0, le=10**12)]
Side = Literal["train", "val", "test"]
SIDES: tuple[Side, ...] = ("train", "val", "test")


class EpisodePart(Document):
    """The ticks of one episode on one side of a split."""

    ticks: Annotated[tuple[Tick, Tick], Strict(False)]
    """[first, stop), counted from the episode's first tick."""
    content: Text
    """Digest of the episode's files."""
    group: Text
    """Episodes of one group are on one side; a single episode may be split by time."""

    @model_validator(mode="after")
    def _has_ticks(self) -> Self:
        if self.ticks[0] >= self.ticks[1]:
            raise ValueError(f"ticks: expected the first before the last, found {self.ticks}")
        return self


class TunedPart(EpisodePart):
    """The ticks of one episode that a model has seen."""

    episode: Text
    """"source/id"."""


class TunedOn(Document):
    """The episodes that a model was tuned on, and those that chose its best step."""

    train: Annotated[tuple[TunedPart, ...], Strict(False)] = ()
    val: Annotated[tuple[TunedPart, ...], Strict(False)] = ()

    @classmethod
    def of_split(cls, split: Mapping[Side, Mapping[str, EpisodePart]]) -> "TunedOn":
        """The train and val sides of a checkpoint's split."""
        parts = {
            side: [{"episode": name, **part.model_dump()} for name, part in split[side].items()]
            for side in SIDES[:2]
        }
        return cls.model_validate(parts)


def joined(several: Iterable[TunedOn | None]) -> TunedOn | None:
    """The episodes of several tunings, one after the other; None where nothing is known."""
    known = [tuned for tuned in several if tuned is not None]
    if not known:
        return None
    return TunedOn(
        train=tuple(dict.fromkeys(part for tuned in known for part in tuned.train)),
        val=tuple(dict.fromkeys(part for tuned in known for part in tuned.val)),
    )


def read_tuned_on(folder: Path) -> TunedOn | None:
    """The episodes that the model in this folder was tuned on; None without such a file.

    Raises `CheckpointIncomplete` where the file is damaged.
    """
    path = folder / TUNED_ON
    return read_document(path, TunedOn)[0] if path.exists() else None


def of_store(attributes: Mapping[str, Any], path: Path) -> TunedOn | None:
    """The episodes that the model of the store at `path` was tuned on; None if unknown.

    Raises `StoreIncomplete` where the attribute is damaged.
    """
    where = f"{path}, attribute {_ATTRIBUTE}"
    document = attributes.get(_ATTRIBUTE)
    return None if document is None else _STORE.parse(document, TunedOn, where)


def store_attributes(tuned: TunedOn | None) -> dict[str, Any]:
    """The attribute for a store; empty where nothing is known."""
    return {} if tuned is None else {_ATTRIBUTE: tuned.model_dump(mode="json")}


def write_tuned_on(folder: Path, tuned: TunedOn) -> None:
    """Write `tuned` beside the weights. Raises `DiskFull`."""
    write_with_digest(folder / TUNED_ON, tuned.model_dump(mode="json"))
