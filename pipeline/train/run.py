"""A training run on disk: its place, what decides its numbers, whether it is resumed or finished.

A run works in `<output>.part` (`run.json`, `best/`, `last/`) and renames it to `<output>` when it
is finished; a stopped run is resumed there. This module does not import torch, which would take
over a second.
"""

import hashlib
import json
import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from pydantic import JsonValue

from pipeline.base.channels import action_groups
from pipeline.base.config import TrainHeadParams
from pipeline.base.differences import differences
from pipeline.base.documents import Document, Text
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch
from pipeline.base.files import (
    REPORT,
    OutputKind,
    begin_folder,
    put_in_place,
    read_document,
    recover,
    recover_folder,
    refuse_foreign,
    remove_folder,
    unmark,
    write_with_digest,
)
from pipeline.base.provenance import SourceDocument
from pipeline.policy.checkpoint import (
    CHECKPOINT,
    DOCUMENT,
    SOURCE_KEYS,
    PolicyDocument,
    check_policy,
)
from pipeline.policy.normalization import Normalization
from pipeline.policy.shape import (
    PolicyShape,
    channel_kinds,
    find_anchors,
    find_relative,
    slot_places,
)
from pipeline.store import FeatureStore, build_lock
from pipeline.train.training_data import list_differences, source_of

RUN, BEST, LAST, STEPS = "run.json", "best", "last", "steps"
TRAINER_WEIGHTS, TRAINER_DOCUMENT = "trainer.safetensors", "trainer.json"
TRAINER_VERSION = 5
"""Raise it with every change of code that changes the numbers of a run. It is part of the run's
identity, so that no run is resumed by code with other numbers."""
FREE_PARAMS = {
    "anew",
    "device",
    "check_store",
    "output",
    "logs",
    "loggers",
    "checkpoint_every",
    "keep_every",
    "store",
    "grad_accumulation",
}
"""Params that may change between a stop and the next start: they decide no number of the run.
`grad_accumulation` is compared as `parts`."""
NOTHING: Mapping[str, Any] = MappingProxyType({})


class RunDocument(Document):
    """The content of `run.json`."""

    source: SourceDocument
    decides: dict[Text, JsonValue]
    """What decided the numbers of the run."""


@dataclass(frozen=True)
class TrainingRun:
    """One training run and its place on disk."""

    output: Path
    status: Literal["new", "resumed", "finished"]
    notes: tuple[str, ...]
    """Lines for the user: what is there, and what will happen."""
    identity: Mapping[str, Any]
    section: str = "train_head"
    """The section of the params with this run's output, steps and rate."""

    @property
    def part(self) -> Path:
        """The folder that the run works in."""
        return _part(self.output)

    @property
    def best(self) -> Path:
        """The checkpoint with the lowest error on val so far."""
        return self.part / BEST

    @property
    def last(self) -> Path:
        """The newest checkpoint, with the trainer's state."""
        return self.part / LAST

    def kept(self, step: int) -> Path:
        """The checkpoint of a step that stays (`keep_every`)."""
        return self.part / STEPS / str(step)

    def begin(self) -> None:
        """Create the part of a new run with its `run.json`; does nothing for a resumed run.

        Another unfinished run that has a checkpoint is moved to `<output>.part-old` and replaces an
        older one there. Call this only when the params are known to be good.
        """
        if self.status != "new":
            return
        begun = (self.part / RUN).exists() and _has_checkpoint(self.part)
        if begun and read_document(self.part / RUN, RunDocument)[1] != self.identity:
            remove_folder(_aside(self.part), RUN_FOLDER)
            self.part.rename(_aside(self.part))
        begin_folder(self.part, RUN_FOLDER)
        write_with_digest(self.part / RUN, self.identity)
        unmark(self.part)

    def finish(self) -> None:
        """Rename the part to the output, in place of an older run, without the trainer's state.

        Only resuming needs that state, and it is four times as large as the trainable parameters.
        """
        put_in_place(self.part, self.output, RUN_FOLDER)
        _drop_trainer_state(self.output)


@contextmanager
def run_lock(params: TrainHeadParams) -> Generator[None]:
    """Lock a run's output and its logs. Raises `StoreLocked` where another run works in either."""
    with build_lock(params.output), build_lock(params.logs):
        yield


def open_run(
    params: TrainHeadParams,
    store: FeatureStore,
    extra_identity: Mapping[str, Any] = NOTHING,
    section: str = "train_head",
) -> TrainingRun:
    """The run of these params on this store: new, resumed or finished.

    It changes nothing of a run but what a kill left half done: a replacement, and a trainer's state
    that a finished run no longer needs. `extra_identity` is what else decides the numbers
    (`FeatureSource.identity`); `section` is the section of the params that errors name. A finished
    run with a damaged checkpoint counts as new: it is trained again and then replaced. Raises
    `CheckpointMismatch` where an unfinished run with a checkpoint saw other features or streams,
    `CheckpointIncomplete` where its `run.json` is damaged, and `ConfigError` where no training
    wrote the output.
    """
    output, identity = params.output, run_identity(params, store, extra_identity)
    part = _part(output)
    notes = []
    recover(part, output, RUN_FOLDER)
    if (output / RUN).exists():
        another = read_document(output / RUN, RunDocument)[1] != identity
        if another or params.anew:
            which = "another run" if another else "this very run"
            notes.append(f"{output} holds {which}; it is replaced when this one is finished")
        else:
            try:
                check_policy(output / BEST)
                check_policy(output / LAST)
                _drop_trainer_state(output)
                note = f"{output} is this very run, finished"
                return TrainingRun(output, "finished", (note,), identity, section)
            except (CheckpointIncomplete, CheckpointMismatch) as why:
                notes.append(f"{output} is this very run, but damaged; it is trained again: {why}")
    refuse_foreign(part, RUN_FOLDER)
    refuse_foreign(params.logs, REPORT)
    if (part / RUN).exists():
        recover_folder(part / BEST, CHECKPOINT)
        recover_folder(part / LAST, CHECKPOINT)
        for half in (part / STEPS).glob("*.new"):
            recover_folder(half.with_suffix(""), CHECKPOINT)
    if (part / RUN).exists() and _has_checkpoint(part):
        if differing := _compare(part, identity, section):
            notes.append(
                f"{part} is an unfinished run of something else; it is put aside as "
                f"{_aside(part)} (that run -> now):\n{differing}"
            )
        elif (part / LAST).exists():
            notes.append(f"resuming the run in {part}")
            return TrainingRun(output, "resumed", tuple(notes), identity, section)
    return TrainingRun(output, "new", tuple(notes), identity, section)


def _is_run(folder: Path) -> bool:
    """Whether a training wrote the folder; beside a checkpoint, `run.json` may be unreadable."""
    if _has_checkpoint(folder):
        return (folder / RUN).is_file()
    try:
        read_document(folder / RUN, RunDocument)
    except CheckpointIncomplete:
        return False
    return True


RUN_FOLDER = OutputKind("a training run", _is_run)


def finished_run(params: TrainHeadParams, path: Path) -> TrainingRun | None:
    """The run of these params on the store at `path` if it is finished, as `open_run` gives it.

    None where it is not. Imports no torch.
    """
    if params.anew or not (params.output / RUN).exists():
        return None
    with build_lock(params.output):
        run = open_run(params, FeatureStore.open(path))
    return run if run.status == "finished" else None


def _compare(part: Path, identity: Mapping[str, Any], section: str) -> str:
    """How the unfinished run in `part` differs; raises `CheckpointMismatch` if its store does."""
    _, prior = read_document(part / RUN, RunDocument)
    if differing := list_differences(prior["source"], identity["source"]):
        raise CheckpointMismatch(
            f"{part}: this unfinished run cannot go on, its store was another one "
            f"(the run -> the store now):\n{differing}\n"
            f"Remove {part} to begin anew, choose another {section}.output, or name the store "
            "it began with in train_head.store."
        )
    return list_differences(prior["decides"], identity["decides"])


def _has_checkpoint(part: Path) -> bool:
    """Whether there is a checkpoint, `<name>.old` and `<name>.new` included."""
    return any(path.is_file() for name in (BEST, LAST) for path in part.glob(f"{name}*/{DOCUMENT}"))


def _drop_trainer_state(output: Path) -> None:
    for name in (TRAINER_WEIGHTS, TRAINER_DOCUMENT):
        (output / LAST / name).unlink(missing_ok=True)


def _part(output: Path) -> Path:
    return output.with_name(f"{output.name}.part")


def _aside(part: Path) -> Path:
    return part.with_name(f"{part.name}-old")


def run_identity(
    params: TrainHeadParams, store: FeatureStore, extra_identity: Mapping[str, Any] = NOTHING
) -> dict[str, Any]:
    """Everything that decides the numbers of a run, as JSON."""
    decides = {
        "trainer_version": TRAINER_VERSION,
        "train_head": params.model_dump(mode="json", exclude=FREE_PARAMS),
        "parts": params.grad_accumulation,
        "front": dict(extra_identity),
        "recordings": recordings_of(store),
    }
    return json.loads(json.dumps({"source": source_of(store), "decides": decides}))


def recordings_of(store: FeatureStore) -> dict[str, Any]:
    """Which episodes and rows a store holds, as `run.json` keeps it."""
    episodes = [[e.source, e.id, e.digest, len(e.ticks)] for e in store.episodes]
    digest = hashlib.blake2b(json.dumps(episodes).encode(), digest_size=16)
    digest.update(store.array("vl/key").tobytes())
    return {"episodes": len(episodes), "ticks": store.ticks, "digest": digest.hexdigest()}


def policy_shape(
    store: FeatureStore,
    normalization: Normalization,
    anchor: Sequence[str] = (),
    action_form: Literal["recorded", "relative"] = "recorded",
    history: int = 1,
) -> PolicyShape:
    """The widths of this store's streams, and which action channels are anchored.

    A stream without statistics is absent from the training ticks, so it has width 0. Raises
    `ConfigError` for an anchored channel whose motion no state of the training ticks measures.
    """
    action, state = store.streams["action"], store.streams["state"]
    known_state = state if normalization.state else {"names": [], "units": []}
    return PolicyShape(
        *store.feature_shape,
        sensor_channels=store.sensor_channels if normalization.sensor else 0,
        state_dim=store.state_dim if normalization.state else 0,
        action_dim=store.action_dim,
        action_groups=action_groups(action["names"], action["units"]),
        views=store.array("vl/frame_time").shape[1],
        state_kinds=channel_kinds(state["names"], state["units"]) if normalization.state else (),
        anchors=find_anchors(action, known_state, anchor),
        relative=find_relative(action, known_state) if action_form == "relative" else (),
        places=slot_places(store.attrs["slots"][: store.feature_shape[0]]),
        history=history,
    )


@dataclass(frozen=True)
class TrainedPolicy:
    """A training run, or a checkpoint copied out of one."""

    folder: Path
    source: Mapping[str, Any] | None = None
    """Its store, as `source_of` describes it."""
    contents: frozenset[str] = frozenset()
    """Digests of the files of its episodes."""
    damage: str | None = None
    """Why it cannot be read, so that nothing else is known."""

    def fits(self, store: FeatureStore) -> bool:
        """Whether a store has its features and all its episodes."""
        here = {episode.content for episode in store.episodes}
        if self.source is None or differences(self.source, source_of(store)):
            return False
        return here.issuperset(self.contents)


def find_trained(folders: Sequence[Path]) -> list[TrainedPolicy]:
    """Every run, finished or not, and every single checkpoint at or below these folders."""
    trained: list[TrainedPolicy] = []
    for folder, below, files in chain.from_iterable(map(os.walk, folders)):
        below.sort()
        documents = [Path(folder, DOCUMENT)] if DOCUMENT in files else []
        if RUN in files:
            documents = sorted(Path(folder).glob(f"*/{DOCUMENT}"))
        if documents:
            below.clear()
            trained.append(_read_trained(Path(folder), documents[0]))
    return trained


def _read_trained(folder: Path, path: Path) -> TrainedPolicy:
    try:
        document, raw = read_document(path, PolicyDocument)
    except CheckpointIncomplete as error:
        return TrainedPolicy(folder, damage=str(error))
    parts = chain.from_iterable(side.values() for side in document.split.values())
    source = {key: raw[key] for key in SOURCE_KEYS}
    return TrainedPolicy(folder, source, frozenset(part.content for part in parts))
