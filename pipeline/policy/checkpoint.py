"""A policy on disk: `policy.safetensors` and a `policy.json` that says all it takes to use it.

The JSON carries the feature spec of the store it was trained from, the streams with their names
and units, the normalisation, the params, and the episodes that it was trained on, chosen on and has
never seen. `golden.safetensors` holds the frames and features of the store's golden rows, where it
has any, by which a live model proves that it gives these features. No pickle.

A kill at any instant leaves the previous checkpoint or the new one.
"""

import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import TrainHeadParams
from pipeline.base.durable import (
    DIGEST,
    check_digest,
    read_tensors,
    read_with_digest,
    replace_folder,
    write_tensors,
    write_with_digest,
)
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch, PipelineError
from pipeline.base.golden import GoldenRow, row_key
from pipeline.base.ownership import OutputKind
from pipeline.base.tuned_on import EpisodePart
from pipeline.policy.normalization import Normalization

# torch takes over a second to import, and what only asks whether a training is finished needs none.
if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from pipeline.policy.observation import PolicyShape
    from pipeline.policy.policy import Policy

FORMAT = 3
"""3: three sides of the split; 2 had two, so that what is reported had chosen the checkpoint."""
WEIGHTS, DOCUMENT, GOLDEN = "policy.safetensors", "policy.json", "golden.safetensors"
_FRAMES = "frames/"
_OF_THE_RUN = ("feed", "loggers", "scratch")
"""Params of a run that tell nothing of its policy; earlier versions had others of them."""
CHECKPOINT = OutputKind("a checkpoint of a policy", lambda folder: (folder / DOCUMENT).is_file())
SOURCE_KEYS = ("feature_spec", "streams", "action_hz", "vlm_reuse_count")
Side = Literal["train", "val", "test"]
SIDES: tuple[Side, ...] = ("train", "val", "test")


@dataclass(frozen=True)
class PolicyCheckpoint:
    """A trained policy and what it was trained from."""

    params: TrainHeadParams
    shape: "PolicyShape"
    normalization: Normalization
    source: Mapping[str, Any]
    """What the store was: `feature_spec`, `streams`, `action_hz`, `vlm_reuse_count`."""
    split: Mapping[Side, Mapping[str, EpisodePart]]
    """What it was trained on (`train`), what chose it (`val`) and what it has never seen (`test`),
    by "source/id" of the episode."""
    step: int
    weights: Mapping[str, "Tensor"]
    metrics: Mapping[str, float] = field(default_factory=dict)
    instructions: tuple[str, ...] = ()
    """What the store's episodes were told; empty where an earlier version wrote the checkpoint."""
    golden: tuple[GoldenRow, ...] = ()
    """Empty where the store has none, or an earlier version wrote the checkpoint."""

    def policy(self, device: "torch.device | str" = "cpu") -> "Policy":
        """The policy with these weights, in evaluation mode; it knows its feature spec."""
        from pipeline.policy.policy import Policy

        policy = Policy(self.params, self.shape, self.normalization)
        policy.feature_spec = self.source["feature_spec"]
        try:
            policy.load_state_dict(dict(self.weights))
        except RuntimeError as error:
            raise CheckpointMismatch(
                f"{WEIGHTS} does not fit the policy that {DOCUMENT} describes: {error}. Train it "
                "again, or use the version of this code that wrote it."
            ) from None
        return policy.to(device).eval()

    def typical(self, stream: str) -> NDArray[np.float64]:
        """What a stream is at its training mean: a reading (channel,), or features (slot, dim)."""
        from pipeline.policy.state_channels import typical_state

        statistics = getattr(self.normalization, stream)
        assert statistics is not None, "a policy has statistics of each stream that it sees"
        if stream != "state":
            return statistics.mean
        return np.array(typical_state(statistics.mean.tolist(), self.shape.kinds))

    def document(self, weights_sha256: str, golden_sha256: str | None = None) -> dict[str, Any]:
        """The content of `policy.json`; the digests are those of the files beside it."""
        said = [{"instruction": row.instruction, "prompt": row.prompt} for row in self.golden]
        golden = {"golden": {"sha256": golden_sha256, "rows": said}} if said else {}
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

    `beside` writes into the same folder what stands beside the policy. Raises `DiskFull`.
    """

    def write(temporary: Path) -> None:
        digests = [write_tensors(temporary / WEIGHTS, checkpoint.weights)]
        if checkpoint.golden:
            digests.append(write_tensors(temporary / GOLDEN, _golden_tensors(checkpoint.golden)))
        write_with_digest(temporary / DOCUMENT, checkpoint.document(*digests))
        beside(temporary)

    replace_folder(folder, write, CHECKPOINT)


@cache
def _note_without_digest(path: Path) -> None:
    """Say it once in a process: a checkpoint is read several times."""
    print(
        f"{path}: it has no {DIGEST}, for an earlier version wrote it, so that nobody can tell "
        "whether it was altered; it is taken as it is. Train it again to have it checked.",
        file=sys.stderr,
    )


def find_policy(path: Path) -> Path:
    """The checkpoint folder that `path` means: itself, or the best of a training's output.

    Raises `CheckpointIncomplete` where neither is one.
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
    from pipeline.policy.observation import PolicyShape

    with _description(folder) as document:
        shape = PolicyShape(**document["shape"])
        return PolicyCheckpoint(
            params=_params(document),
            shape=replace(
                shape,
                action_groups=tuple(shape.action_groups),
                state_kinds=tuple(shape.state_kinds),
            ),
            normalization=Normalization.from_document(document["normalization"]),
            source={key: document[key] for key in SOURCE_KEYS},
            split={
                side: {
                    name: EpisodePart.model_validate(part)
                    for name, part in document["split"][side].items()
                }
                for side in SIDES
            },
            step=document["step"],
            metrics=document["metrics"],
            instructions=tuple(document.get("instructions", ())),
            weights=read_tensors(folder / WEIGHTS, document["weights_sha256"]),
            golden=_read_golden(folder, document),
        )


def check_policy(folder: Path) -> TrainHeadParams:
    """The params of the checkpoint at `folder`, of which no weight is opened.

    Raises `CheckpointIncomplete` and `CheckpointMismatch` as `load_policy`.
    """
    with _description(folder) as document:
        check_digest(folder / WEIGHTS, document["weights_sha256"])
        if "golden" in document:
            check_digest(folder / GOLDEN, document["golden"]["sha256"])
        Normalization.from_document(document["normalization"])
        return _params(document)


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


def _read_golden(folder: Path, document: Mapping[str, Any]) -> tuple[GoldenRow, ...]:
    """The golden rows; their keys are those under the feature spec of the document."""
    if "golden" not in document:
        return ()
    spec, rows = document["feature_spec"], list[GoldenRow]()
    tensors = read_tensors(folder / GOLDEN, document["golden"]["sha256"])
    for number, said in enumerate(document["golden"]["rows"]):
        own = {
            name.removeprefix(f"{number}/"): tensor.numpy()
            for name, tensor in tensors.items()
            if name.startswith(f"{number}/")
        }
        frames = {n.removeprefix(_FRAMES): own[n] for n in own if n.startswith(_FRAMES)}
        key = row_key(spec["digest"], spec["views"], said["prompt"], frames)
        rows.append(
            GoldenRow(
                key, **said, frames=frames, features=own["features"], slot_valid=own["slot_valid"]
            )
        )
    return tuple(rows)


def _params(document: Mapping[str, Any]) -> TrainHeadParams:
    given: Mapping[str, Any] = document["params"]["train_head"]
    return TrainHeadParams.model_validate(
        {name: value for name, value in given.items() if name not in _OF_THE_RUN}
    )


@contextmanager
def _description(folder: Path) -> Generator[dict[str, Any]]:
    """The document of a checkpoint; what it lacks where it is read is `CheckpointIncomplete`."""
    path = folder / DOCUMENT
    document, has_digest = read_with_digest(path)
    if not has_digest:
        _note_without_digest(path)
    if document.get("format") != FORMAT:
        raise CheckpointMismatch(
            f"{path}: expected format {FORMAT}, found {document.get('format')!r}. Checkpoints of "
            "formats before 3 do not tell what chose them from what reports them. Train it again "
            "with this version."
        )
    try:
        yield document
    except PipelineError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise CheckpointIncomplete(
            f"{path}: not what a checkpoint's description must be ({type(error).__name__}: "
            f"{error}). Train it again."
        ) from None
