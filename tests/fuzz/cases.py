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
from tests.fuzz.corpus import ARCHIVE, HEAD, RECORDINGS, STORE, params
from tests.fuzz.mutations import Change, change_any


@dataclass(frozen=True)
class Subject:
    """A thing of the corpus."""

    kind: str
    """Its class in the table."""
    place: str
    """Where it lies in a case's folder, as in the corpus."""
    stage: str = "extract"
    """What reads it: a command; or, in a tenth of the time, the part of one that reads."""
    sets: dict[str, str] = field(default_factory=dict)
    """What its command is told, where {} is its place, and {corpus} that of the corpus."""


_HEAD = {"evaluate.checkpoint": "{}", "evaluate.store": f"{{corpus}}/{STORE}"}
SUBJECTS = {
    **{name: Subject("recordings", name, "read") for name in RECORDINGS},
    "vlm": Subject("VLM folders", "vlm", sets={"vlm.checkpoint": "{}"}),
    "adapter": Subject("adapters", "adapter", sets={"vlm.adapter": "{}"}),
    "store": Subject("stores", STORE, "verify"),
    "archive": Subject("archives", ARCHIVE, "archive", {"archive.restore": "true"}),
    "head": Subject("trained heads", HEAD, "load", _HEAD),
}
TURN = ["recordings"] * 9 + ["VLM folders"] * 2 + ["adapters"] * 2 + ["stores"] * 3
TURN += ["archives"] + ["trained heads"] * 2
"""The classes of the cases, over and over."""
CLASSES = tuple(dict.fromkeys(TURN))


@dataclass(frozen=True)
class Case:
    """One changed thing in a folder of its own, and the command that reads it."""

    seed: int
    number: int
    corpus: Path
    whole: str = ""
    """The thing of a case in which nothing is changed."""
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

    @cached_property
    def thing(self) -> str:
        """The name of what is changed."""
        if self.whole:
            return self.whole
        return self.rng.choice([name for name, s in SUBJECTS.items() if s.kind == self.kind])

    @property
    def subject(self) -> Subject:
        """What is changed."""
        return SUBJECTS[self.thing]

    @property
    def stage(self) -> str:
        """What reads it."""
        return self.subject.stage

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
        return self.corpus / f"{self.thing}.baseline"

    @property
    def arguments(self) -> list[str]:
        """The options of the command."""
        words = {k: v.format(self.place, corpus=self.corpus) for k, v in self.subject.sets.items()}
        options = [word for key in words for word in ("--set", f"{key}={words[key]}")]
        return ["--params", str(self.folder / "params.yaml"), *options]

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
        return change_any(self.rng, self.place, self.corpus / "other" / self.subject.place)

    def run(self) -> int:
        """The exit code of the command, whose messages go to this process's stderr."""
        parts = {"read": oracle.read_all, "load": oracle.load_head}
        return run(
            "", parts.get(self.stage) or import_module(f"stages.{self.stage}").main, self.arguments
        )

    def judge(self, change: Change) -> str:
        """After exit 0: what is not as the files have it; empty where all is right."""
        try:
            return oracle.judge(self, change)
        except Exception as error:
            return f"its judge cannot read it: {type(error).__name__}: {error!s:.300}"


def wholes(corpus: Path) -> list[Case]:
    """Every thing of a corpus as it is."""
    return [Case(-1, number, corpus, name) for number, name in enumerate(SUBJECTS)]
