"""What a store and a policy trained from it say alike: features, streams, clocks."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pipeline.base.border import Document, Text

ViewName = Annotated[str, Field(max_length=200, pattern=r"^[^/\x00.][^/\x00]*$")]
"""A name that is a file's too: it neither climbs nor enters a folder."""
_Small = Annotated[int, Field(ge=0, le=2**20)]


class Slot(Document):
    """One pooled vector of a VL row."""

    layer: _Small
    norm: bool
    pooling: Text
    view: ViewName | None = None
    cell: Annotated[list[_Small], Field(min_length=2, max_length=2)] | None = None
    variant: _Small = 0


class Spec(Document):
    """The feature spec, as far as it is used beyond being compared."""

    digest: Text
    views: list[ViewName]
    slots: list[Slot]
    dim: _Small | None = None
    variants: Annotated[int, Field(ge=1, le=1000)] = 1


class Channels(Document):
    """What the channels of a stream are called, and their units; none where a store lacks it."""

    names: list[Text]
    units: list[Text]

    @model_validator(mode="after")
    def _each_has_a_unit(self) -> Self:
        if len(self.names) != len(self.units):
            raise ValueError(f"{len(self.names)} names, but {len(self.units)} units")
        return self


class ActionChannels(Channels):
    """Those of the action, and what a number of it means."""

    kind: Literal["absolute", "velocity", "delta"]


class Streams(Document):
    """The channels of every stream, and the views."""

    action: ActionChannels
    sensor: Channels
    state: Channels
    views: list[ViewName]


class SourceDocument(Document):
    """What a policy keeps of the store that it was trained from."""

    feature_spec: Spec
    streams: Streams
    action_hz: Annotated[float, Field(gt=0, le=10**6)] | None
    vlm_reuse_count: Annotated[int, Field(ge=1, le=10**5)]
