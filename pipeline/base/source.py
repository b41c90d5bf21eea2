"""Documents that a store and a policy share: feature spec, streams, clocks."""

import re
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from pipeline.base.border import Document, Text


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

    layer: _Small
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
