"""Which episodes a model was tuned on: beside its weights, and in the stores of its features."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.base.config.section import Section
from pipeline.base.durable import damaged, read_document, write_with_digest
from pipeline.base.errors import CheckpointIncomplete

TUNED_ON = "tuned_on.json"
"""In the folder of an adapter, or of a checkpoint that was tuned whole: no part of its digest."""
_ATTRIBUTE = "tuned_on"
"""Of a store, where its model says it."""


class EpisodePart(Section):
    """The ticks of one episode on one side of a split."""

    ticks: tuple[int, int]
    """[first, stop), counted in the episode."""
    content: str
    """Digest of the episode's files."""
    group: str
    """Episodes of one group are on one side, but for a single one that is cut by time."""


class TunedPart(EpisodePart):
    """Those that a model has seen."""

    episode: str
    """As "source/id"."""


class TunedOn(Section):
    """What a model was tuned on, and what its best step was chosen on."""

    train: tuple[TunedPart, ...] = ()
    val: tuple[TunedPart, ...] = ()

    @classmethod
    def of_split(cls, split: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> "TunedOn":
        """That of the `split` of a checkpoint's document."""
        parts = {
            side: [{"episode": name, **part} for name, part in split[side].items()]
            for side in cls.model_fields
        }
        return cls.model_validate(parts)


def joined(several: Iterable[TunedOn | None]) -> TunedOn | None:
    """What a model was tuned on one after the other; None where nothing is known."""
    known = [tuned for tuned in several if tuned is not None]
    if not known:
        return None
    return TunedOn(
        train=tuple(dict.fromkeys(part for tuned in known for part in tuned.train)),
        val=tuple(dict.fromkeys(part for tuned in known for part in tuned.val)),
    )


def read_tuned_on(folder: Path) -> TunedOn | None:
    """What the model in this folder was tuned on; None where it does not say.

    Raises `CheckpointIncomplete` where the file is damaged.
    """
    path = folder / TUNED_ON
    if not path.is_file():
        return None
    try:
        return TunedOn.model_validate(read_document(path))
    except ValidationError as error:
        raise CheckpointIncomplete(damaged(path, error)) from None


def of_store(attributes: Mapping[str, Any]) -> TunedOn | None:
    """What the model of a store with these attributes was tuned on; None where it does not say."""
    document = attributes.get(_ATTRIBUTE)
    return None if document is None else TunedOn.model_validate(document)


def store_attributes(tuned: TunedOn | None) -> dict[str, Any]:
    """What a store says of it; nothing where nothing is known, as of every other store."""
    return {} if tuned is None else {_ATTRIBUTE: tuned.model_dump(mode="json")}


def write_tuned_on(folder: Path, tuned: TunedOn) -> None:
    """Write it beside the weights. Raises `DiskFull`."""
    write_with_digest(folder / TUNED_ON, tuned.model_dump(mode="json"))
