"""A case: which thing, what is done to it, and which command reads it.

A case is known by the suite's seed and its number alone. `make`, `run` and `judge` happen in a
process of their own.
"""

import os
import shutil
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from random import Random

import yaml

from stages.command import run
from tests.fuzz import oracle
from tests.fuzz.corpus import ARCHIVE, HEAD, REAL, RECORDINGS, STORE, params
from tests.fuzz.hostile import CANARY, HOSTILE
from tests.fuzz.mutations import Change, change_any

ROOT = Path(__file__).parents[2]
_PARTS = {"read": "extract", "load": "evaluate"}
"""The parts of commands that read, which take a tenth of the time, and their commands."""


@dataclass(frozen=True)
class Subject:
    """A thing of the corpus."""

    kind: str
    """Its class in the table."""
    place: str
    """Where it lies in a case's folder, as in the corpus."""
    stages: tuple[str, ...] = ("extract",)
    """What reads it: each as often as it stands here."""
    sets: dict[str, str] = field(default_factory=dict)
    """What its command is told, where {} is its place, and {corpus} that of the corpus."""


_HEAD = {"evaluate.checkpoint": "{}", "evaluate.store": f"{{corpus}}/{STORE}"}
SUBJECTS = {
    **{n: Subject("recordings", n, ("read",) * 3 + ("extract",)) for n in (*RECORDINGS, *REAL)},
    "vlm": Subject("VLM folders", "vlm", sets={"vlm.checkpoint": "{}"}),
    "adapter": Subject("adapters", "adapter", sets={"vlm.adapter": "{}"}),
    "store": Subject("stores", STORE, ("verify", "verify", "train_head")),
    "archive": Subject("archives", ARCHIVE, ("archive",), {"archive.restore": "true"}),
    "head": Subject("trained heads", HEAD, ("load",) * 3 + ("evaluate",), _HEAD),
}
TURN = (["recordings"] * 9 + ["VLM folders"] * 2 + ["adapters"] * 2 + ["stores"] * 3) + (
    ["archives"] + ["trained heads"] * 2 + ["hostile"] * 3
)
"""The classes of the cases, over and over."""
CLASSES = tuple(dict.fromkeys(TURN))


@dataclass(frozen=True)
class Case:
    """One changed thing in a folder of its own, and the command that reads it."""

    seed: int
    number: int
    corpus: Path
    whole: tuple[str, str] | None = None
    """The thing and the stage of a case in which nothing is changed."""
    seconds: float = 10.0
    """Of processor time that it may take; and six times as long by the clock."""

    @cached_property
    def rng(self) -> Random:
        """Gives the same to whoever asks in the same order."""
        return Random(f"{self.seed}-{self.number}")

    @property
    def kind(self) -> str:
        """The class of the table."""
        return TURN[self.number % len(TURN)]

    @property
    def turn(self) -> int:
        """How many cases of its class come before it."""
        rounds, place = divmod(self.number, len(TURN))
        return rounds * TURN.count(self.kind) + TURN[:place].count(self.kind)

    @cached_property
    def thing(self) -> str:
        """The name of what is changed; hostile changes come each in its turn."""
        if self.whole:
            return self.whole[0]
        if self.kind == "hostile":
            return HOSTILE[self.turn % len(HOSTILE)][0]
        names = [n for n, s in SUBJECTS.items() if s.kind == self.kind and n not in REAL]
        real = [name for name in REAL if (self.corpus / name).exists()]
        return self.rng.choice(names + real * (self.kind == "recordings"))

    @property
    def subject(self) -> Subject:
        """What is changed."""
        return SUBJECTS[self.thing]

    @cached_property
    def stage(self) -> str:
        """What reads it."""
        drawn = Random(f"{self.seed}-{self.number}-stage")
        return self.whole[1] if self.whole else drawn.choice(self.subject.stages)

    @property
    def folder(self) -> Path:
        """Where all of it lies, and where the command runs."""
        return self.corpus.parent / f"case-{self.seed}-{self.number}"

    @property
    def place(self) -> Path:
        """Where the thing lies."""
        return self.folder / self.subject.place

    @property
    def baseline(self) -> Path:
        """Where the result is kept that the thing gives as it is in the corpus."""
        stage = "read" if self.subject.kind == "recordings" else self.stage
        return self.corpus / f"{self.thing}-{stage}.baseline"

    @property
    def arguments(self) -> list[str]:
        """The options of the command."""
        words = {k: v.format(self.place, corpus=self.corpus) for k, v in self.subject.sets.items()}
        options = [word for key in words for word in ("--set", f"{key}={words[key]}")]
        return ["--params", str(self.folder / "params.yaml"), *options]

    @property
    def command(self) -> list[str]:
        """As a user types it."""
        return ["python", "-m", f"stages.{_PARTS.get(self.stage, self.stage)}", *self.arguments]

    def make(self) -> Change:
        """Lay the thing out as it is in the corpus, linked, and do to it what the number says."""
        self.folder.mkdir(parents=True)
        data = self.thing if self.subject.kind == "recordings" else "lerobot_images"
        document = params(self.corpus, data, self.folder)
        if data != self.thing:
            document["data"]["root"] = str(self.corpus)
        (self.folder / "params.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
        if not self.place.exists():
            source = self.corpus / self.subject.place
            shutil.copytree(source, self.place, copy_function=os.link)
        if self.whole:
            return Change("nothing", self.place, "same")
        if self.kind == "hostile":
            _, pattern, what, act, *permitted = HOSTILE[self.turn % len(HOSTILE)]
            paths = sorted(path for path in self.folder.rglob(pattern) if path.is_file())
            path = self.rng.choice(paths)
            act(path)
            permits = permitted[0] if permitted else "refuse"
            sound = self.subject.kind != "recordings" and what != "a terabyte"
            return Change(what, path, permits, sound=sound or bool(permitted))
        return change_any(self.rng, self.place, self.corpus / "other" / self.subject.place)

    def run(self) -> int:
        """The exit code of the command, whose messages go to this process's stderr."""
        parts = {"read": oracle.read_all, "load": oracle.load_head}
        return run(
            "", parts.get(self.stage) or import_module(f"stages.{self.stage}").main, self.arguments
        )

    def judge(self, change: Change) -> str:
        """After exit 0: what is not as the files have it; empty where all is right."""
        if (self.folder / CANARY).exists():
            return "code of the file was executed"
        try:
            return oracle.judge(self, change)
        except Exception as error:
            return f"its judge cannot read it: {type(error).__name__}: {error!s:.300}"


def wholes(corpus: Path) -> list[Case]:
    """Every thing of a corpus as it is, with every stage whose result is kept."""
    pairs = [
        (name, stage)
        for name, subject in SUBJECTS.items()
        if (corpus / subject.place).exists()
        for stage in dict.fromkeys(subject.stages)
        if subject.kind != "recordings" or stage == "read"
    ]
    return [Case(-1, number, corpus, pair) for number, pair in enumerate(pairs)]
