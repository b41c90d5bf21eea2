"""The content of `policy.json` as a model: types, bounds, and what must fit together.

Without torch, which takes over a second to import.
"""

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from pipeline.base.border import Document, Text, shown
from pipeline.base.config import TrainHeadParams
from pipeline.base.source import MOST_GOLDEN, SIDES, EpisodePart, Side, SourceDocument
from pipeline.policy.normalization import Normalization
from pipeline.policy.shape import MOST, PolicyShape

FORMAT: Literal[3] = 3
"""3: three sides of the split; 2 had two, so that what is reported had chosen the checkpoint."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class GoldenTexts(Document):
    """The texts of a golden row."""

    instruction: Text
    prompt: Annotated[str, Field(max_length=1_000_000)]


class GoldenDocument(Document):
    """The golden rows; their arrays lie in a file of their own."""

    sha256: Sha256
    rows: Annotated[tuple[GoldenTexts, ...], Field(min_length=1, max_length=MOST_GOLDEN)]


class PolicyParams(Document):
    """The sections of params.yaml that a policy is made from."""

    train_head: TrainHeadParams

    @field_validator("train_head", mode="before")
    @classmethod
    def _without_run_params(cls, params: object) -> object:
        """Leave out params of the run alone, of which earlier versions had others."""
        if not isinstance(params, dict):
            return params
        return {k: params[k] for k in params if k not in ("feed", "loggers", "scratch")}


class PolicyDocument(SourceDocument):
    """The content of `policy.json`."""

    format: Literal[3]
    step: Annotated[int, Field(ge=0)]
    metrics: dict[Text, float]
    params: PolicyParams
    shape: PolicyShape
    instructions: Annotated[tuple[Text, ...], Field(max_length=MOST)] = ()
    split: dict[Side, dict[Text, EpisodePart]]
    weights_sha256: Sha256
    normalization: Normalization
    golden: GoldenDocument | None = None

    @model_validator(mode="after")
    def _widths_fit(self) -> Self:
        shape, streams, spec = self.shape, self.streams, self.feature_spec
        plain = [slot for slot in spec.slots if not slot.variant]
        expected: dict[str, tuple[object, set[object]]] = {
            "shape.action_groups": (len(shape.action_groups), {shape.action_dim}),
            "shape.state_kinds": (len(shape.state_kinds), {0, shape.state_dim}),
            "shape.slots": (shape.slots, {len(plain)}),
            "shape.feature_dim": (shape.feature_dim, {spec.dim}),
            # 0 of a stream that the policy does not see, and of views in an earlier version.
            "shape.sensor_channels": (shape.sensor_channels, {0, len(streams.sensor.names)}),
            "shape.state_dim": (shape.state_dim, {0, len(streams.state.names)}),
            "shape.views": (shape.views, {0, len(streams.views)}),
            "streams.action.names": (len(streams.action.names), {shape.action_dim}),
            "feature_spec.views": (tuple(spec.views), {tuple(streams.views)}),
        }
        for place, (actual, fitting) in expected.items():
            if actual not in fitting:
                any_of = " or ".join(sorted(map(shown, fitting)))
                raise ValueError(f"{place}: expected {any_of}, found {shown(actual)}")
        for anchor in shape.anchors:
            pairs = ((anchor.action, shape.action_dim), (anchor.state, shape.state_dim))
            if any(channel >= size for channels, size in pairs for channel in channels):
                raise ValueError(f"shape.anchors: expected channels that are there, found {anchor}")
        for stream, size in shape.channels.items():
            fitted = getattr(self.normalization, stream)
            actual = fitted and (fitted.mean.shape, fitted.std.shape)
            if actual != (size, size) and not (fitted is None and 0 in size):
                why = f"expected mean and std of {size}, found {actual}"
                raise ValueError(f"normalization.{stream}: {why}")
        return self

    @model_validator(mode="after")
    def _sides_are_apart(self) -> Self:
        if {*self.split} != {*SIDES}:
            raise ValueError(f"split: expected {', '.join(SIDES)}, found {', '.join(self.split)}")
        parts = ((part, side) for side, own in self.split.items() for part in own.values())
        ticks = sorted((part.content, part.ticks, side) for part, side in parts)
        for (content, (_, stop), side), (other, (first, _), there) in pairwise(ticks):
            if content == other and first < stop and side != there:
                raise ValueError(
                    f"split: expected each tick on one side, found some of {shown(content)} in "
                    f"both {side} and {there}"
                )
        return self
