"""CortexBench's protocol with this project's pipeline: stores, policies and rollouts of a variant.

    OUT/demonstrations/TASK     recorded sets; OUT/demonstrations-3-mm/TASK those with noise
    OUT/vlm                     the demo's model of random weights; any other with --checkpoint
    OUT/tuned                   the same, tuned on the demonstrations of all five tasks
    OUT/stores/VARIANT-TASK.zarr
    OUT/policies/VARIANT-TASK-SEED/{model, rollout/STEP}
    OUT/parts.csv               how long each part of a run took, and how many it did

What is done already is not done again, so a run that was stopped goes on.
"""

import os
import re
import time
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import yaml
from tqdm import tqdm

from experiments.metaworld.recording import VERSION, Record, record, seeds_of
from pipeline.base.config import Params, load_params
from pipeline.base.errors import CheckpointIncomplete, ConfigError
from pipeline.base.files import read_document
from pipeline.extract.run import extract
from pipeline.policy.checkpoint import DOCUMENT, PolicyDocument
from pipeline.simulation.meta_world import INSTRUCTIONS
from stages import finetune, rollout, train_head

EPISODES: Final = 31
"""Demonstrations of a task: the split leaves 25 to 29 to train on; the protocol has 25."""
PARTS: Final = "parts.csv"
"""Lines of part, seconds of wall clock, and how many episodes, rows or policies it made."""
JOINT: Final = "all"
"""In place of a task: one policy for all five, whatever tasks are asked for."""
_PARAMS: Final = Path(__file__).with_name("params.yaml")


@dataclass(frozen=True)
class Variant:
    """What differs from `params.yaml`; stores of variants with equal `rows` are shared."""

    features: tuple[str, ...] = ()
    policy: tuple[str, ...] = ()
    tuned: bool = False
    """Whether the model is tuned on all five tasks first, and then frozen again."""
    joint: bool = False
    """Whether one policy learns all five tasks."""
    noise_mm: float = 0.0
    """Of the demonstrations; see `Record`."""

    @property
    def rows(self) -> tuple[object, ...]:
        """What decides the rows of a store."""
        return self.features, self.tuned, self.noise_mm


_TOKENS: Final = (
    "vlm.image_resize_height=224",
    "vlm.image_resize_width=224",
    "vlm.pooling=[tokens]",
    "extract.dtype=int8",
)
_POOLER: Final = ("train_head.feature_encoder={kind: pooler}",)
VARIANTS: Final[dict[str, Variant]] = {
    "protocol": Variant(policy=("train_head.keep_every=500",)),
    "one policy": Variant(joint=True),
    "mean": Variant(features=("vlm.pooling=[mean]",)),
    "last": Variant(features=("vlm.pooling=[last]",)),
    "grid 2x2": Variant(features=("vlm.pooling=[{grid: [2, 2]}]",)),
    "224 pixels": Variant(
        features=("vlm.image_resize_height=224", "vlm.image_resize_width=224", "vlm.grid=[8, 8]")
    ),
    "tokens": Variant(features=_TOKENS, policy=_POOLER),
    "two layers": Variant(features=(*_TOKENS, "vlm.layers=[1, -1]"), policy=_POOLER),
    "vision": Variant(features=(*_TOKENS, "vlm.layers=[vision]"), policy=_POOLER),
    "features off": Variant(policy=("train_head.features_enabled=false",)),
    "state off": Variant(policy=("train_head.robot_state_enabled=false",)),
    "feature history 3": Variant(policy=("train_head.feature_history=3",)),
    "anchored": Variant(policy=("train_head.anchor=[dx, dy, dz]",)),
    "noise": Variant(noise_mm=3.0),
    "reuse 1": Variant(features=("data.vlm_reuse_count=1",)),
    "reuse 3": Variant(features=("data.vlm_reuse_count=3",)),
    "reuse 30": Variant(features=("data.vlm_reuse_count=30",)),
    "tuned": Variant(tuned=True),
}


@dataclass(frozen=True)
class Run:
    """What a run of the protocol is asked for."""

    out: Path
    variants: tuple[str, ...]
    tasks: tuple[str, ...] = tuple(INSTRUCTIONS)
    seeds: int = 3
    episodes: int = 25
    jobs: int = 1
    checkpoint: str | None = None
    settings: tuple[str, ...] = ()
    """Params that differ from `params.yaml`; what a variant or the run itself sets wins."""

    def policies(self) -> Iterator["TrainedPolicy"]:
        """The policies of all variants, by seed first: a table of one seed is soon there."""
        for seed, name in product(range(self.seeds), self.variants):
            tasks = (JOINT,) if VARIANTS[name].joint else self.tasks
            yield from (TrainedPolicy(self, name, task, seed) for task in tasks)


@dataclass(frozen=True)
class TrainedPolicy:
    """One policy: where it lies, and what it is made and judged by."""

    run: Run
    variant: str
    task: str
    seed: int

    @property
    def folder(self) -> Path:
        """Where its training and its rollouts are."""
        return self.run.out / "policies" / f"{_slug(self.variant)}-{self.task}-{self.seed}"

    @property
    def model(self) -> Path:
        """The run of its training."""
        return self.folder / "model"

    @property
    def checkpoints(self) -> dict[int, Path]:
        """Its checkpoints that are rolled out, by step; the training has to be finished.

        Raises `CheckpointIncomplete` where the document of one is damaged.
        """
        found = (*self.model.glob("steps/*"), self.model / "best", self.model / "last")
        return {read_document(one / DOCUMENT, PolicyDocument)[0].step: one for one in found}

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks that it learns."""
        return tuple(INSTRUCTIONS) if self.task == JOINT else (self.task,)

    @property
    def store(self) -> Path:
        """Its store, which policies of equal `rows` share."""
        own = VARIANTS[self.variant].rows
        same = (name for name, variant in VARIANTS.items() if variant.rows == own)
        return self.run.out / "stores" / f"{_slug(next(same))}-{self.task}.zarr"

    def params(self, *settings: str) -> Params:
        """Its params."""
        run, variant = self.run, VARIANTS[self.variant]
        sources = [{"name": task, "path": task} for task in self.tasks]
        told = [f"data.sources={yaml.safe_dump(sources, default_flow_style=True, width=9999)}"]
        told += [f"vlm.checkpoint={run.checkpoint}"] if run.checkpoint else []
        told += [f"vlm.adapter={run.out / 'tuned' / 'best' / 'adapter'}"] if variant.tuned else []
        told += [
            *run.settings,
            f"data.root={_demonstrations(run, variant.noise_mm)}",
            f"extract.store={self.store}",
            f"train_head.seed={self.seed}",
            f"train_head.split={{val: 0.1, test: 0.05, seed: {self.seed}}}",
            f"train_head.output={self.model}",
            f"train_head.logs={self.folder / 'logs'}",
            f"rollout.environment={[f'metaworld:{task}' for task in self.tasks]}",
            f"rollout.seed={seeds_of('evaluation', self.seed)[0]}",
            f"rollout.episodes={run.episodes}",
        ]
        told += [*variant.features, *variant.policy, *settings]
        return load_params(run.out / "params.yaml", told)

    def rollout(self, step: int) -> Path:
        """Where the rollout of a checkpoint is or will be."""
        return self.folder / "rollout" / str(step)

    @property
    def missing(self) -> dict[int, Path]:
        """The checkpoints without a rollout of as many episodes as the run asks for."""
        wanted = self.run.episodes * len(self.tasks)
        return {at: folder for at, folder in self.checkpoints.items() if self._played(at) < wanted}

    def _played(self, step: int) -> int:
        folder = self.rollout(step)
        if not (folder / "report.html").exists():  # written last
            return 0
        return len((folder / "episodes.csv").read_text(encoding="utf-8").splitlines()) - 1

    @property
    def done(self) -> bool:
        """Whether it is trained, and all of its rollouts are there."""
        try:
            return self.model.exists() and not self.missing
        except CheckpointIncomplete:
            return False


def found_policies(out: Path) -> Iterator[TrainedPolicy]:
    """The policies of the folder, those too that are not finished."""
    names = {_slug(name): name for name in VARIANTS}
    form = re.compile(rf"({'|'.join(names)})-({JOINT}|[a-z-]+-v3)-(\d+)")
    for folder in sorted((out / "policies").glob("*/")):
        if told := form.fullmatch(folder.name):
            slug, task, seed = told.groups()
            any_number = Run(out, (names[slug],), episodes=1)
            yield TrainedPolicy(any_number, names[slug], task, int(seed))


def run_protocol(wanted: Run) -> None:
    """Do what is missing: recordings, model, stores, policies, rollouts."""
    prepare(wanted)
    _record(wanted)
    missing = [policy for policy in wanted.policies() if not policy.done]
    if any(VARIANTS[policy.variant].tuned for policy in missing):
        _tune(wanted)
    _extract(wanted, {policy.store: policy for policy in missing}.values())
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // wanted.jobs)))
    with _timed(wanted.out, "policies") as made:
        pool = ProcessPoolExecutor(wanted.jobs, get_context("spawn"), max_tasks_per_child=1)
        try:
            begun = [pool.submit(train_and_roll_out, policy) for policy in missing]
            ends = tqdm(as_completed(begun), "policies", len(begun), unit="policy", disable=None)
            for ended in ends:
                ended.result()
        finally:  # what is under way may end, nothing more begins
            pool.shutdown(cancel_futures=True)
            made.append(sum(policy.done for policy in missing))


def prepare(wanted: Run) -> None:
    """Write the params that all policies in the folder share, and the demo's model.

    Raises `ConfigError` for a wrong setting, and where the folder was begun with others, whose
    policies would be mixed up with those of now.
    """
    load_params(_PARAMS, ["data.sources=[{name: task, path: task}]", *wanted.settings])
    wanted.out.mkdir(parents=True, exist_ok=True)
    asked = {"checkpoint": wanted.checkpoint, "recorder": VERSION}
    asked |= {"set": [*wanted.settings]} if wanted.settings else {}
    text = f"# run with {asked}\n" + _PARAMS.read_text(encoding="utf-8")
    text, file = text.replace("{out}", str(wanted.out)), wanted.out / "params.yaml"
    if file.exists() and file.read_text(encoding="utf-8") != text:
        raise ConfigError(
            f"{file}: expected the params of now ({asked}), found those of another run. Name "
            "another folder with --out"
        )
    file.write_text(text, encoding="utf-8")
    if wanted.checkpoint is None and not (wanted.out / "vlm").exists():
        from pipeline.vlm.demo_checkpoint import write_demo_checkpoint

        write_demo_checkpoint(wanted.out / "vlm")


@contextmanager
def _timed(out: Path, part: str) -> Generator[list[int]]:
    """Note how long a part took, also when it is stopped; the caller appends what it made."""
    made, begun = list[int](), time.perf_counter()
    try:
        yield made
    finally:
        with (out / PARTS).open("a", encoding="utf-8") as file:
            file.write(f"{part},{time.perf_counter() - begun:.1f},{sum(made)}\n")


def _record(wanted: Run) -> None:
    variants = [VARIANTS[name] for name in wanted.variants]
    five = any(variant.joint or variant.tuned for variant in variants)
    tasks = [*INSTRUCTIONS] if five else wanted.tasks
    for noise_mm in sorted({variant.noise_mm for variant in variants}):
        asked = [
            Record(version=VERSION, task=task, run=0, episodes=EPISODES, noise_mm=noise_mm)
            for task in tasks
        ]
        folder = _demonstrations(wanted, noise_mm)
        missing = [folder / task for task in tasks if not (folder / task).exists()]
        with _timed(wanted.out, "recorded episodes") as made:
            try:
                record(folder, asked, wanted.jobs)
            finally:
                made.append(EPISODES * sum(task.exists() for task in missing))


def _extract(wanted: Run, policies: Iterable[TrainedPolicy]) -> None:
    with _timed(wanted.out, "extracted rows") as made:
        for policy in policies:
            if (report := extract(policy.params(), say=print)) is not None:
                made.append(report.computed)


def train_and_roll_out(policy: TrainedPolicy) -> None:
    """Train a policy, and roll out its checkpoints.

    What the stages print stands in a file beside its folder.
    """
    policy.folder.mkdir(parents=True, exist_ok=True)
    with policy.folder.with_suffix(".log").open("a") as log, redirect_stdout(log):
        train_head.main(policy.params())
        for step, folder in policy.missing.items():
            told = f"rollout.checkpoint={folder}", f"rollout.output={policy.rollout(step)}"
            rollout.main(policy.params(*told))


def _tune(wanted: Run) -> None:
    """Tune the model on all tasks, with a policy for all of them on top."""
    joint, tuned = TrainedPolicy(wanted, "one policy", JOINT, 0), wanted.out / "tuned"
    if not tuned.exists():
        told = f"finetune.output={tuned}", f"finetune.logs={wanted.out / 'tuning'}"
        _extract(wanted, [joint])
        with _timed(wanted.out, "tuned models") as made:
            finetune.main(joint.params(*told))
            made.append(1)


def _demonstrations(run: Run, noise_mm: float) -> Path:
    return run.out / (f"demonstrations-{noise_mm:g}-mm" if noise_mm else "demonstrations")


def _slug(name: str) -> str:
    return name.replace(" ", "-")
