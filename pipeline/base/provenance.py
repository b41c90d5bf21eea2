"""Where features come from, as recordings, stores, adapters and policies share it.

Feature spec, streams and clocks; golden rows, with whose frames the features can be computed again
on another machine and without a recording; and the episodes that the model was tuned on.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, Strict, model_validator

from pipeline.base.documents import Border, Document, Text
from pipeline.base.errors import StoreIncomplete
from pipeline.base.files import read_document, write_with_digest


def is_view_name(name: str) -> bool:
    """Whether it can be the name of a folder beside zarr's own files, not a path into another.

    zarr reads a backslash as a slash.
    """
    whole = re.fullmatch(r"(?!\.|zarr\.json$)[^/\\\x00]+", name)
    return whole is not None and len(name.encode()) <= 200


def _view_name(name: str) -> str:
    if not is_view_name(name):
        what = "at most 200 bytes, no /, \\ or NUL, no dot first, not zarr.json"
        raise ValueError(f"expected a name of {what}")
    return name


ViewName = Annotated[str, Field(max_length=200), AfterValidator(_view_name)]
"""A view's name, in a recording and in a store."""
_Small = Annotated[int, Field(ge=0, le=2**20)]


class SlotDocument(Document):
    """One pooled vector of a VL row, as `pipeline.vlm.slots.Slot.document` writes it."""

    layer: _Small | Literal["vision"]
    norm: bool
    pooling: Text
    view: ViewName | None = None
    cell: Annotated[list[_Small], Field(min_length=2, max_length=2)] | None = None
    variant: _Small = 0


class Spec(Document):
    """The entries of a feature spec that code uses, besides comparing them."""

    digest: Text
    views: list[ViewName]
    slots: list[SlotDocument]
    dim: _Small | None = None
    variants: Annotated[int, Field(ge=1, le=1000)] = 1


class Channels(Document):
    """Names and units of a stream's channels; empty where a store lacks the stream."""

    names: list[Text]
    units: list[Text]

    @model_validator(mode="after")
    def _each_has_a_unit(self) -> Self:
        if len(self.names) != len(self.units):
            raise ValueError(f"{len(self.names)} names, but {len(self.units)} units")
        return self


class ActionChannels(Channels):
    """The action's channels, and the meaning of its numbers."""

    kind: Literal["absolute", "velocity", "delta"]


CLOCK_SLACK_S = 1e-6
"""Clocks are rounded, so a reading older than a window by less than this counts as in it."""
RATE_TOLERANCE = 0.1
"""Rates count as equal if they differ by at most this share."""


class Streams(Document):
    """The channels of every stream, and the views."""

    action: ActionChannels
    sensor: Channels
    state: Channels
    views: list[ViewName]


class SourceDocument(Document):
    """The entries of its store that a policy keeps."""

    feature_spec: Spec
    streams: Streams
    action_hz: Annotated[float, Field(gt=0, le=10**6)] | None
    vlm_reuse_count: Annotated[int, Field(ge=1, le=10**6)]


MOST_GOLDEN = 4
"""Most golden rows in a store."""

Frames = Mapping[str, NDArray[np.uint8]]
"""View -> (height, width, 3) RGB as decoded, before any resize; without missing views."""


@dataclass(frozen=True, eq=False)
class GoldenRow:
    """A VL row with all inputs of its features, and the stored features."""

    key: bytes
    """`row_key` of its feature spec, prompt and frames."""
    instruction: str
    prompt: str
    """The rendered prompt."""
    frames: Frames
    features: NDArray[np.float32]
    """(slot, dim), of the plain frames."""
    slot_valid: NDArray[np.bool_]
    """(slot,)"""


def row_key(spec_digest: str, views: Sequence[str], prompt: str, frames: Frames) -> bytes:
    """16 bytes that differ for every other spec, rendered prompt or frames in view order."""
    digest = hashlib.blake2b(digest_size=16)
    for text in (spec_digest, prompt):
        _add(digest, text.encode())
    for view in views:
        if view in frames:
            frame = np.ascontiguousarray(frames[view])
            _add(digest, f"{view} {frame.shape} {frame.dtype}".encode())
            digest.update(frame.data)
    return digest.digest()


def spread(rows: NDArray[np.int64], views: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most `MOST_GOLDEN` of these rows, evenly spread over those with the most views.

    `views` (row,) is the number of views of each row.
    """
    full = rows[views == views.max(initial=0)]
    places = np.linspace(0, max(0, len(full) - 1), min(MOST_GOLDEN, len(full)))
    return full[np.unique(places.round().astype(np.int64))]


def _add(digest: "hashlib.blake2b", part: bytes) -> None:
    # The length comes first, so that a character moved to the next part changes the key.
    digest.update(len(part).to_bytes(8, "little"))
    digest.update(part)


TUNED_ON = "tuned_on.json"
"""The file in the folder of an adapter or a tuned checkpoint; not part of its digest."""
_ATTRIBUTE = "tuned_on"
"""The attribute of a store whose model has such a file."""
_STORE = Border(StoreIncomplete, "Copy the store again, or extract it anew with stages.extract.")

Tick = Annotated[int, Field(ge=0, le=10**12)]
Side = Literal["train", "val", "test"]
SIDES: tuple[Side, ...] = ("train", "val", "test")


class SplitPart(Document):
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


class TunedPart(SplitPart):
    """The ticks of one episode that a model has seen."""

    episode: Text
    """"source/id"."""


class TunedOn(Document):
    """The episodes that a model was tuned on, and those that chose its best step."""

    train: Annotated[tuple[TunedPart, ...], Strict(False)] = ()
    val: Annotated[tuple[TunedPart, ...], Strict(False)] = ()

    @classmethod
    def of_split(cls, split: Mapping[Side, Mapping[str, SplitPart]]) -> "TunedOn":
        """The train and val sides of a checkpoint's split."""
        parts = {
            side: [{"episode": name, **part.model_dump()} for name, part in split[side].items()]
            for side in SIDES[:2]
        }
        return cls.model_validate(parts)


def join_tuned_on(several: Iterable[TunedOn | None]) -> TunedOn | None:
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


def tuned_on_of_store(attributes: Mapping[str, Any], path: Path) -> TunedOn | None:
    """The episodes that the model of the store at `path` was tuned on; None if unknown.

    Raises `StoreIncomplete` where the attribute is damaged.
    """
    where = f"{path}, attribute {_ATTRIBUTE}"
    document = attributes.get(_ATTRIBUTE)
    return None if document is None else _STORE.parse(document, TunedOn, where)


def tuned_on_attributes(tuned: TunedOn | None) -> dict[str, Any]:
    """The attribute for a store; empty where nothing is known."""
    return {} if tuned is None else {_ATTRIBUTE: tuned.model_dump(mode="json")}


def write_tuned_on(folder: Path, tuned: TunedOn) -> None:
    """Write `tuned` beside the weights. Raises `DiskFull`."""
    write_with_digest(folder / TUNED_ON, tuned.model_dump(mode="json"))
