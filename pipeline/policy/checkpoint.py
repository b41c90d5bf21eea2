"""A policy on disk: `policy.safetensors`, and everything needed to use it in `policy.json`.

The JSON has the feature spec of the store, the streams with their names and units, the
normalisation, the params, and the episodes of training, val and test. `golden.safetensors` has the
frames and features of the store's golden rows, against which a live model is checked. There is no
pickle. A kill at any instant leaves the previous checkpoint or the new one. The module imports
torch, which takes over a second, only where weights are read.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from pipeline.base.config import TrainHeadParams
from pipeline.base.config.section import Section
from pipeline.base.differences import describe, differences
from pipeline.base.documents import Document, Text, shown
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch, PipelineError
from pipeline.base.files import (
    RUN_FILES,
    OutputKind,
    check_digest,
    read_document,
    read_tensors,
    replace_folder,
    write_tensors,
    write_with_digest,
)
from pipeline.base.provenance import (
    MOST_GOLDEN,
    SIDES,
    GoldenRow,
    Side,
    SourceDocument,
    SplitPart,
    row_key,
)
from pipeline.policy.normalization import ChannelStatistics, Normalization
from pipeline.policy.shape import MOST, PolicyShape, slot_places, typical_state

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from pipeline.policy.policy import Policy

FORMAT: Literal[3] = 3
"""3: the split has three sides; in 2 it had two, and the reported side chose the checkpoint."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
WEIGHTS, DOCUMENT, GOLDEN = "policy.safetensors", "policy.json", "golden.safetensors"
_FRAMES = "frames/"
CHECKPOINT = OutputKind("a checkpoint of a policy", lambda folder: (folder / DOCUMENT).is_file())
_Layout = dict[str, tuple[str, tuple[int, ...]]]
"""The dtype and the shape of each tensor."""
SOURCE_KEYS = ("feature_spec", "streams", "action_hz", "vlm_reuse_count")


class GoldenTexts(Document):
    """The texts of a golden row."""

    instruction: Text
    prompt: Annotated[str, Field(max_length=1_000_000)]


class GoldenDocument(Document):
    """The golden rows; `golden.safetensors` has their arrays."""

    sha256: Sha256
    rows: Annotated[tuple[GoldenTexts, ...], Field(min_length=1, max_length=MOST_GOLDEN)]


class PolicyParams(Document):
    """The sections of params.yaml that a policy is made from."""

    train_head: TrainHeadParams

    @field_validator("train_head", mode="before")
    @classmethod
    def _without_run_params(cls, params: object) -> object:
        """Leave out what only a run needs, and keys of other versions.

        `FORMAT` rises where a key that changes a policy's answers is dropped.
        """
        if not isinstance(params, dict):
            return params
        known = _known(TrainHeadParams, params)
        known.pop("loggers", None)
        return known


def _known(section: type[Section], document: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a document that a section has."""
    known: dict[str, Any] = {}
    for name, entry in section.model_fields.items():
        if name in document:
            value, kind = document[name], entry.annotation
            if isinstance(value, dict) and isinstance(kind, type) and issubclass(kind, Section):
                value = _known(kind, value)
            known[name] = value
    return known


class PolicyDocument(SourceDocument):
    """The content of `policy.json`."""

    format: Literal[3]
    step: Annotated[int, Field(ge=0)]
    metrics: dict[Text, float]
    params: PolicyParams
    shape: PolicyShape
    instructions: Annotated[tuple[Text, ...], Field(max_length=MOST)] = ()
    split: dict[Side, dict[Text, SplitPart]]
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
            "shape.history": (shape.history, {self.params.train_head.feature_history}),
            "shape.feature_dim": (shape.feature_dim, {spec.dim}),
            "shape.places": (
                shape.places,
                {(), slot_places([slot.model_dump(exclude_none=True) for slot in plain])},
            ),
            # 0 where the policy does not see the stream; earlier versions had no views.
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
        if any(len(pair.action) != 1 or len(pair.state) != 1 for pair in shape.relative):
            raise ValueError("shape.relative: expected one action and one state channel each")
        for anchor in (*shape.anchors, *shape.relative):
            pairs = ((anchor.action, shape.action_dim), (anchor.state, shape.state_dim))
            if any(channel >= size for channels, size in pairs for channel in channels):
                raise ValueError(f"shape.anchors: expected channels that are there, found {anchor}")
        if bool(shape.relative) != (self.normalization.relative is not None):
            raise ValueError(
                "normalization.relative: expected it just where shape.relative has some"
            )
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


@dataclass(frozen=True)
class PolicyCheckpoint:
    """A trained policy and what it was trained from."""

    params: TrainHeadParams
    shape: PolicyShape
    normalization: Normalization
    source: Mapping[str, Any]
    """Of the store: `feature_spec`, `streams`, `action_hz`, `vlm_reuse_count`."""
    split: Mapping[Side, Mapping[str, SplitPart]]
    """The episodes by "source/id": trained on (`train`), chosen on (`val`), never seen (`test`)."""
    step: int
    weights: Mapping[str, "Tensor"]
    metrics: Mapping[str, float] = field(default_factory=dict)
    instructions: tuple[str, ...] = ()
    """Of the store's episodes; empty where an earlier version wrote the checkpoint."""
    golden: tuple[GoldenRow, ...] = ()
    """Empty where the store has none, or an earlier version wrote the checkpoint."""
    digest: str = ""
    """SHA-256 of the weights' file; empty before the checkpoint is saved."""

    def policy(self, device: "torch.device | str" = "cpu") -> "Policy":
        """The policy with these weights and its feature spec, in evaluation mode."""
        from pipeline.policy.policy import Policy

        policy = Policy(self.params, self.shape, self.normalization)
        policy.feature_spec = self.source["feature_spec"]
        policy.load_state_dict(dict(self.weights))
        return policy.to(device).eval()

    def statistics(self, stream: str) -> ChannelStatistics:
        """The training statistics of a stream, for features those of a row's slots (slot, dim)."""
        fitted: ChannelStatistics | None = getattr(self.normalization, stream)
        assert fitted is not None, "a policy has statistics of every stream that it sees"
        return fitted.at(self.shape.statistics_of) if stream == "features" else fitted

    def typical(self, stream: str) -> NDArray[np.float64]:
        """The training mean of a stream: a reading (channel,), or the features of a sample."""
        statistics = self.statistics(stream)
        if stream == "features":
            return np.tile(statistics.mean, (self.shape.history, 1))
        if stream != "state":
            return statistics.mean
        return np.array(typical_state(statistics.mean.tolist(), self.shape.kinds))

    def document(self, weights_sha256: str, golden_sha256: str | None = None) -> dict[str, Any]:
        """The content of `policy.json`; the digests are those of the files beside it."""
        rows = [{"instruction": row.instruction, "prompt": row.prompt} for row in self.golden]
        golden = {"golden": {"sha256": golden_sha256, "rows": rows}} if rows else {}
        return {
            "format": FORMAT,
            "step": self.step,
            "metrics": dict(self.metrics),
            "params": {"train_head": self.params.model_dump(mode="json")},
            "shape": asdict(self.shape),
            **self.source,
            "instructions": list(self.instructions),
            "split": {
                side: {name: part.model_dump(mode="json") for name, part in parts.items()}
                for side, parts in self.split.items()
            },
            "weights_sha256": weights_sha256,
            "normalization": self.normalization.document(),
            **golden,
        }


def save_policy(
    folder: Path, checkpoint: PolicyCheckpoint, beside: Callable[[Path], None] = lambda folder: None
) -> None:
    """Put a checkpoint at `folder`, in place of an older one there, atomically.

    `beside` writes further files into the same folder. Raises `DiskFull`.
    """

    def write(temporary: Path) -> None:
        digests = [write_tensors(temporary / WEIGHTS, checkpoint.weights)]
        if checkpoint.golden:
            digests.append(write_tensors(temporary / GOLDEN, _golden_tensors(checkpoint.golden)))
        write_with_digest(temporary / DOCUMENT, checkpoint.document(*digests))
        beside(temporary)

    replace_folder(folder, write, CHECKPOINT)


def find_policy(path: Path) -> Path:
    """The checkpoint folder at `path`: itself, or the best checkpoint of a training's output.

    Raises `CheckpointIncomplete` where there is neither.
    """
    for folder in (path, path / "best"):
        if (folder / DOCUMENT).exists():
            return folder
    part = path.with_name(f"{path.name}.part")
    unfinished = f" There is an unfinished training in {part}." if part.exists() else ""
    raise CheckpointIncomplete(
        f"{path}: expected a checkpoint ({DOCUMENT} in it or in its folder best), found none."
        f"{unfinished} Run stages.train_head (or stages.finetune) to its end, or name another "
        "checkpoint."
    )


def load_policy(folder: Path) -> PolicyCheckpoint:
    """The checkpoint at `folder`.

    Raises `CheckpointIncomplete` naming the file that is missing, truncated or altered.
    """
    document, content = read_document(folder / DOCUMENT, PolicyDocument)
    path, described = folder / WEIGHTS, _described_weights(folder, document)
    weights = read_tensors(path, document.weights_sha256)
    _check_tensors(path, weights, described)
    return PolicyCheckpoint(
        params=document.params.train_head,
        shape=document.shape,
        normalization=document.normalization,
        source={key: content[key] for key in SOURCE_KEYS},
        split=document.split,
        step=document.step,
        metrics=document.metrics,
        instructions=document.instructions,
        weights=weights,
        golden=_read_golden(folder, document),
        digest=document.weights_sha256,
    )


def check_policy(folder: Path) -> None:
    """Raise `CheckpointIncomplete` as `load_policy` does; opens no weights."""
    document, _ = read_document(folder / DOCUMENT, PolicyDocument)
    check_digest(folder / WEIGHTS, document.weights_sha256)
    if document.golden is not None:
        check_digest(folder / GOLDEN, document.golden.sha256)


def _described_weights(folder: Path, document: PolicyDocument) -> _Layout:
    """The layout of the described policy, which is built without memory: it may be huge.

    Raises `CheckpointIncomplete` where no such policy can be built.
    """
    import torch

    from pipeline.policy.policy import Policy

    try:
        with torch.device("meta"):
            policy = Policy(document.params.train_head, document.shape, document.normalization)
    except (RuntimeError, PipelineError) as error:
        raise RUN_FILES.refusal(folder / DOCUMENT, error) from None
    return _layout(policy.state_dict())


def _layout(tensors: "Mapping[str, Tensor]") -> _Layout:
    return {name: (str(value.dtype), tuple(value.shape)) for name, value in tensors.items()}


def _check_tensors(path: Path, tensors: "Mapping[str, Tensor]", expected: _Layout) -> None:
    """Raise `CheckpointMismatch` where a file's tensors are not those of the document.

    Raises `CheckpointIncomplete` where a number in them is not finite.
    """
    if differing := describe(differences(_layout(tensors), expected)):
        more = f" and {len(differing) - 1} more" if len(differing) > 1 else ""
        raise CheckpointMismatch(
            f"{path} does not fit the policy that {DOCUMENT} describes (the file -> the policy): "
            f"{differing[0]}{more}. Copy both again, train it again, or use the version of this "
            "code that wrote it."
        )
    for name, values in tensors.items():
        if not values.isfinite().all():
            raise RUN_FILES.refusal(path, f"{name}: expected finite numbers, found NaN or infinity")


def _golden_tensors(rows: Sequence[GoldenRow]) -> "dict[str, Tensor]":
    """`<n>/features`, `<n>/slot_valid` and `<n>/frames/<view>` of each row n."""
    import torch

    return {
        f"{number}/{name}": torch.from_numpy(np.array(values))
        for number, row in enumerate(rows)
        for name, values in {
            "features": row.features,
            "slot_valid": row.slot_valid,
            **{f"{_FRAMES}{view}": frame for view, frame in row.frames.items()},
        }.items()
    }


def _read_golden(folder: Path, document: PolicyDocument) -> tuple[GoldenRow, ...]:
    """The golden rows, with their keys under the document's feature spec."""
    if document.golden is None:
        return ()
    path, spec, shape = folder / GOLDEN, document.feature_spec, document.shape
    tensors = read_tensors(path, document.golden.sha256)
    expected: _Layout = {}
    frames_of: list[dict[str, Tensor]] = []
    for number in range(len(document.golden.rows)):
        expected[f"{number}/features"] = "torch.float32", (shape.slots, shape.feature_dim)
        expected[f"{number}/slot_valid"] = "torch.bool", (shape.slots,)
        places = {view: f"{number}/{_FRAMES}{view}" for view in spec.views}
        there = {view: tensors[at] for view, at in places.items() if at in tensors}
        frames_of.append({view: frame for view, frame in there.items() if frame.numel()})
        for view, frame in frames_of[-1].items():
            expected[places[view]] = "torch.uint8", (*frame.shape[:2], 3)
    _check_tensors(path, tensors, expected)
    rows: list[GoldenRow] = []
    for number, (row, own) in enumerate(zip(document.golden.rows, frames_of, strict=True)):
        frames = {view: frame.numpy() for view, frame in own.items()}
        features, valid = (tensors[f"{number}/{n}"].numpy() for n in ("features", "slot_valid"))
        key = row_key(spec.digest, spec.views, row.prompt, frames)
        rows.append(GoldenRow(key, row.instruction, row.prompt, frames, features, valid))
    return tuple(rows)
