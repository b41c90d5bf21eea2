"""Where a training run lies on disk, and whether it begins, goes on or is done.

A run works in `<output>.part` (`run.json`, `best/`, `last/`) and renames it to `<output>` when it
is finished. DVC deletes an output before it runs a stage, but not the `.part` beside it, so that a
stopped run goes on under `dvc repro` too.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.base.config import TrainHeadParams
from pipeline.base.differences import Differences, describe, differences
from pipeline.base.durable import (
    damaged,
    put_in_place,
    read_document,
    recover,
    recover_folder,
    write_with_digest,
)
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch, ConfigError
from pipeline.base.ownership import (
    REPORT,
    OutputKind,
    begin_folder,
    refuse_foreign,
    remove_folder,
    there,
    unmark,
)
from pipeline.policy.checkpoint import (
    CHECKPOINT,
    DOCUMENT,
    SOURCE_KEYS,
    check_policy,
    source_differences,
)
from pipeline.store import FeatureStore, build_lock
from pipeline.train.identity import NOTHING, run_identity

RUN, BEST, LAST = "run.json", "best", "last"
TRAINER_WEIGHTS, TRAINER_DOCUMENT = "trainer.safetensors", "trainer.json"
Status = Literal["new", "resumed", "finished"]


@dataclass(frozen=True)
class Run:
    """A place on disk with room for one training run."""

    output: Path
    status: Status
    notes: tuple[str, ...]
    """What was found and will be done, for the user."""
    identity: Mapping[str, Any]
    section: str = "train_head"
    """Of the params: the one that names this run's output, steps and rate."""

    @property
    def part(self) -> Path:
        """The folder that the run works in."""
        return _part(self.output)

    @property
    def best(self) -> Path:
        """The checkpoint with the lowest held-out error so far."""
        return self.part / BEST

    @property
    def last(self) -> Path:
        """The newest checkpoint, with everything that going on from it takes."""
        return self.part / LAST

    def begin(self) -> None:
        """Make room for a new run and leave its `run.json`; nothing for one that goes on.

        Another unfinished run is put aside to `<output>.part-old`, in place of an older one there,
        unless it has no checkpoint. Called when nothing can be wrong with the params any more.
        """
        if self.status != "new":
            return
        begun = (self.part / RUN).exists() and _has_checkpoint(self.part)
        if begun and read_document(self.part / RUN) != self.identity:
            remove_folder(_aside(self.part), RUN_FOLDER)
            self.part.rename(_aside(self.part))
        begin_folder(self.part, RUN_FOLDER)
        write_with_digest(self.part / RUN, self.identity)
        unmark(self.part)

    def finish(self) -> None:
        """Rename the part to the output, in place of an older run, and drop what only resuming
        takes: the optimizer's state and the weights before averaging, four times what learns."""
        put_in_place(self.part, self.output, RUN_FOLDER)
        _drop_trainer_state(self.output)


def open_run(
    params: TrainHeadParams,
    store: FeatureStore,
    extra_identity: Mapping[str, Any] = NOTHING,
    section: str = "train_head",
) -> Run:
    """The run of these params on this store: new, resumed or finished.

    `extra_identity` is what else decides its numbers (`FeatureSource.identity`); `section` of the
    params is the one that errors name.

    Begins nothing. A finished run with a damaged checkpoint is new: trained again, then replaced.
    Raises `CheckpointMismatch` when an unfinished run with a checkpoint saw other features or other
    streams, `CheckpointIncomplete` when its `run.json` is damaged, and `ConfigError` when the
    output is something that no training wrote.
    """
    output, identity = params.output, run_identity(params, store, extra_identity)
    part = _part(output)
    notes = []
    _refuse_to_replace(output, section)
    recover(output, RUN_FOLDER)
    if (output / RUN).exists():
        if read_document(output / RUN) != identity:
            notes.append(f"{output} holds another run; it is replaced when this one is finished")
        elif (why := _damage(output)) is None:
            _drop_trainer_state(output)
            return Run(output, "finished", _finished_notes(params), identity, section)
        else:
            notes.append(f"{output} is this very run, but damaged; it is trained again: {why}")
    if _has_checkpoint(part) and not (part / RUN).exists():
        raise ConfigError(
            f"{part} has checkpoints but no {RUN}, so it cannot be told what run they are of. "
            f"Move it away or choose another {section}.output."
        )
    refuse_foreign(part, RUN_FOLDER)
    refuse_foreign(params.logs, REPORT)
    if (part / RUN).exists():
        recover_folder(part / BEST, CHECKPOINT)
        recover_folder(part / LAST, CHECKPOINT)
    if (part / RUN).exists() and _has_checkpoint(part):
        differing = _compare(part, identity, section)
        if differing:
            notes.append(
                f"{part} is an unfinished run of something else; it is put aside as "
                f"{_aside(part)} (that run -> now):\n{_indented(differing)}"
            )
        elif (part / LAST).exists():
            notes.append(f"resuming the run in {part}")
            return Run(output, "resumed", tuple(notes), identity, section)
    return Run(output, "new", tuple(notes), identity, section)


def _is_run(folder: Path) -> bool:
    """Whether a training wrote it; a `run.json` that cannot be read is a damaged one of ours only
    beside a checkpoint."""
    if _has_checkpoint(folder):
        return (folder / RUN).is_file()
    try:
        return {"source", "decides"} <= read_document(folder / RUN).keys()
    except CheckpointIncomplete:
        return False


RUN_FOLDER = OutputKind("a training run", _is_run)


def _refuse_to_replace(output: Path, section: str) -> None:
    if there(output) and not RUN_FOLDER.owns(output):
        raise ConfigError(
            f"{section}.output: {output} exists and is no training run (it has no {RUN} of one), "
            "and a finished run would replace it. Choose another output or move it away."
        )


def finished_run(params: TrainHeadParams, path: Path) -> Run | None:
    """The run of these params on the store at `path` where it is finished, else None.

    What `open_run` gives, without torch, which takes over a second to import; None where several
    processes train together.
    """
    together = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if together or not (params.output / RUN).exists():
        return None
    with build_lock(params.output):
        run = open_run(params, FeatureStore.open(path))
    return run if run.status == "finished" else None


def _damage(output: Path) -> str | None:
    """What is wrong with a finished run's checkpoints; None where both are whole."""
    try:
        for name in (BEST, LAST):
            check_policy(output / name)
    except (CheckpointIncomplete, CheckpointMismatch) as error:
        return str(error)
    return None


def _finished_notes(params: TrainHeadParams) -> tuple[str, ...]:
    said = f"{params.output} is this very run, finished"
    logs = check_policy(params.output / LAST).logs
    if logs == params.logs:
        return (said,)
    return said, f"its curves are left where they were written, in {logs}, not in {params.logs}"


def _compare(part: Path, identity: Mapping[str, Any], section: str) -> Differences:
    """What else the unfinished run in `part` was to be; refused where its store was another."""
    prior = read_document(part / RUN)
    source = prior.get("source")
    if not isinstance(source, dict) or {*SOURCE_KEYS} - {*source} or "decides" not in prior:
        raise CheckpointIncomplete(damaged(part / RUN, "not what it must hold"))
    differing = source_differences(source, identity["source"])
    if differing:
        raise CheckpointMismatch(
            f"{part}: this unfinished run cannot go on, its store was another one "
            f"(the run -> the store now):\n{_indented(differing)}\n"
            f"Remove {part} to begin anew, choose another {section}.output, or name the store "
            "it began with in train_head.store."
        )
    return differences(prior["decides"], identity["decides"])


def _indented(differing: Differences) -> str:
    return "\n".join(f"  {line}" for line in describe(differing))


def _has_checkpoint(part: Path) -> bool:
    """Whether there is a checkpoint; by its document, `<name>.old` and `<name>.new` too."""
    return any(path.is_file() for name in (BEST, LAST) for path in part.glob(f"{name}*/{DOCUMENT}"))


def _drop_trainer_state(output: Path) -> None:
    for name in (TRAINER_WEIGHTS, TRAINER_DOCUMENT):
        (output / LAST / name).unlink(missing_ok=True)


def _part(output: Path) -> Path:
    return output.with_name(f"{output.name}.part")


def _aside(part: Path) -> Path:
    return part.with_name(f"{part.name}-old")
