"""Where a training run lies on disk, and whether it begins, goes on or is done.

A run works in `<output>.part` (`run.json`, `best/`, `last/`) and renames it to `<output>` when it
is finished. DVC deletes an output before it runs a stage, but not the `.part` beside it, so that a
stopped run goes on under `dvc repro` too.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.checkpoint import DOCUMENT, describe, differences, source_differences, source_of
from pipeline.config import TrainHeadParams
from pipeline.durable import read_document, recover_folder, write_document
from pipeline.errors import CheckpointMismatch, ConfigError
from pipeline.store import FeatureStore

RUN, BEST, LAST = "run.json", "best", "last"
TRAINER_WEIGHTS, TRAINER_DOCUMENT = "trainer.safetensors", "trainer.json"
FREE_PARAMS = {"device", "output", "logs", "checkpoint_every", "store"}
"""Params that may change between a stop and the next start: they decide no number of the run."""

Status = Literal["new", "resumed", "finished"]


@dataclass(frozen=True)
class Run:
    """A place on disk with room for one training run."""

    output: Path
    status: Status
    notes: tuple[str, ...]
    """What was found and done, for the user."""

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

    def finish(self) -> None:
        """Rename the part to the output, in place of an older run, and drop what only resuming
        takes: the optimizer's state and the weights before averaging, three times the policy."""
        replaced = _replaced(self.output)
        if self.output.exists():
            self.output.rename(replaced)
        self.part.rename(self.output)
        if replaced.exists():
            shutil.rmtree(replaced)
        _drop_trainer_state(self.output)


def open_run(params: TrainHeadParams, store: FeatureStore) -> Run:
    """The run of these params on this store: new, resumed or finished.

    An unfinished run of other params or recordings is moved aside to `<output>.part-old`. Raises
    `CheckpointMismatch` when the unfinished run saw other features or other streams, and
    `ConfigError` when the output is something that no training wrote.
    """
    output, identity = params.output, run_identity(params, store)
    part = _part(output)
    notes = []
    _recover(output)
    if output.exists():
        finished = _finished_identity(output)
        if finished == identity:
            _drop_trainer_state(output)
            return Run(output, "finished", (f"{output} is this very run, finished",))
        notes.append(f"{output} holds another run; it is replaced when this one is finished")
    if any(part.glob(f"*/{DOCUMENT}")) and not (part / RUN).exists():
        raise ConfigError(
            f"{part} has checkpoints but no {RUN}, so it cannot be told what run they are of. "
            "Move it away or choose another train_head.output."
        )
    notes += _make_room(part, identity)
    if (part / RUN).exists():
        recover_folder(part / BEST)
        recover_folder(part / LAST)
        if (part / LAST).exists():
            return Run(output, "resumed", (*notes, f"resuming the run in {part}"))
    part.mkdir(parents=True, exist_ok=True)
    write_document(part / RUN, identity)
    return Run(output, "new", tuple(notes))


def run_identity(params: TrainHeadParams, store: FeatureStore) -> dict[str, Any]:
    """Everything that decides the numbers of a run, as JSON."""
    episodes = [[e.source, e.id, e.digest, len(e.ticks)] for e in store.episodes]
    digest = hashlib.blake2b(json.dumps(episodes).encode(), digest_size=16)
    digest.update(store.array("vl/key").tobytes())
    decides = {
        "train_head": params.model_dump(mode="json", exclude=FREE_PARAMS),
        "recordings": {
            "episodes": len(store.episodes),
            "ticks": store.ticks,
            "digest": digest.hexdigest(),
        },
    }
    return json.loads(json.dumps({"source": source_of(store), "decides": decides}))


def _finished_identity(output: Path) -> Mapping[str, Any] | None:
    if (output / RUN).exists():
        return read_document(output / RUN)
    if output.is_dir() and not any(output.iterdir()):
        return None
    raise ConfigError(
        f"train_head.output: {output} exists and is no training run (it has no {RUN}), and a "
        "finished run would replace it. Choose another output or move it away."
    )


def _refuse_other_source(prior: Mapping[str, Any], identity: Mapping[str, Any], part: Path) -> None:
    differing = source_differences(prior["source"], identity["source"])
    if differing:
        raise CheckpointMismatch(
            f"{part}: this unfinished run cannot go on, its store was another one:\n"
            f"{describe(differing, 'the run', 'the store now')}\n"
            f"Remove {part} to begin anew, choose another train_head.output, or name the store "
            "it began with in train_head.store."
        )


def _make_room(part: Path, identity: Mapping[str, Any]) -> list[str]:
    """Leave in `part` this run or nothing, and say what was done.

    Another unfinished run is put aside. If it is this run that was put aside before, the two
    change places: a mistyped param costs no training.
    """
    aside, between = part.with_name(f"{part.name}-old"), part.with_name(f"{part.name}-between")
    if between.exists() and not aside.exists():  # killed while two runs changed places
        between.rename(aside)
    differing = {}
    if (part / RUN).exists():
        prior = read_document(part / RUN)
        _refuse_other_source(prior, identity, part)
        differing = differences(prior["decides"], identity["decides"])
        if not differing:
            return []
        part.rename(between)
    notes = []
    if (aside / RUN).exists() and read_document(aside / RUN) == identity:
        aside.rename(part)
        notes.append(f"{aside} is this run, put aside earlier: taken back")
    if between.exists() and not any(between.glob(f"*/{DOCUMENT}")):
        shutil.rmtree(between)  # it had only begun
    if between.exists():
        if aside.exists():
            shutil.rmtree(aside)
        between.rename(aside)
        notes.append(
            f"{part} was an unfinished run of something else; it is kept as {aside}:\n"
            f"{describe(differing, 'that run', 'now')}"
        )
    return notes


def _drop_trainer_state(output: Path) -> None:
    for name in (TRAINER_WEIGHTS, TRAINER_DOCUMENT):
        (output / LAST / name).unlink(missing_ok=True)


def _recover(output: Path) -> None:
    """Undo or complete a `finish` that a kill stopped."""
    replaced = _replaced(output)
    if replaced.exists() and output.exists():
        shutil.rmtree(replaced)
    elif replaced.exists():
        replaced.rename(output)


def _replaced(output: Path) -> Path:
    return output.with_name(f"{output.name}.part-replaced")


def _part(output: Path) -> Path:
    return output.with_name(f"{output.name}.part")
