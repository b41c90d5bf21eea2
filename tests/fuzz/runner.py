"""Run cases, each in a process that was forked from this one, under limits, and say how they ended.

This process imports all that a command needs and computes nothing, so that it can be forked.
"""

import gc
import io
import os
import pickle
import resource
import select
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from tests.fuzz.cases import Case
from tests.fuzz.mutations import Change
from tests.fuzz.oracle import unclear

BYTES = 2 * 2**30
"""That a case may take more than what is imported."""
OUTCOMES = ("right", "clear", "unclear", "traceback", "hang", "crash", "over memory", "wrong")
GOOD = ("right", "clear")
_IMPORTED = (
    "torch scipy.stats matplotlib.figure stages.extract stages.verify stages.archive "
    "stages.train_head stages.evaluate pipeline.extract.engine pipeline.vlm.loading "
    "pipeline.train.loop pipeline.train.log transformers.models.qwen2_5_vl.modeling_qwen2_5_vl "
    "transformers.models.qwen2.tokenization_qwen2 peft.tuners.lora"
)


def warm() -> None:
    """Import what takes seconds, and compute nothing."""
    for name in _IMPORTED.split():
        import_module(name)
    gc.collect()
    gc.freeze()  # what is not touched need not be copied for each child


@dataclass(frozen=True)
class Verdict:
    """How a case ended."""

    case: Case
    outcome: str
    why: str
    told: dict[str, Any]
    """What the case's process told of its steps."""
    stderr: str

    @property
    def good(self) -> bool:
        """Whether it is one of the two outcomes that the rule allows."""
        return self.outcome in GOOD

    def __str__(self) -> str:
        change: Change = self.told["made"]
        text = self.stderr.strip().replace("\n", "\n  ")
        return (
            f"case {self.case.number} ({self.case.kind}): {self.outcome}: {self.why}\n"
            f"  {os.path.relpath(change.path, self.case.folder)}: {change.what}\n"
            f"  {self.case.stage} {' '.join(self.case.arguments)}\n  {text}\n"
            f"  again: python -m tests.fuzz.table --seed {self.case.seed} --case {self.case.number}"
        )


@dataclass
class _Child:
    """The process of a case that runs, and what it has told."""

    case: Case
    begun: float = field(default_factory=time.monotonic)
    said: bytes = b""
    killed: bool = False

    def __post_init__(self) -> None:
        shutil.rmtree(self.case.folder, ignore_errors=True)
        self.pipe, write = os.pipe()
        self.number = os.fork()
        if not self.number:
            _in_child(self.case, write)
        os.close(write)

    def listen(self, ready: bool) -> bool:
        """Take what it tells now; whether it has come to its end."""
        if ready:
            part = os.read(self.pipe, 2**16)
            self.said, self.begun = self.said + part, time.monotonic()
            return not part
        # By the clock, for what waits for a pipe; a busy machine takes longer than the limit.
        if not self.killed and time.monotonic() - self.begun > 6 * self.case.seconds:
            self.killed = True
            os.killpg(self.number, signal.SIGKILL)
        return False

    def verdict(self, keep: bool) -> Verdict:
        """How it ended."""
        os.close(self.pipe)
        _, status = os.waitpid(self.number, 0)
        with suppress(ProcessLookupError):
            os.killpg(self.number, signal.SIGKILL)
        steps, told = io.BytesIO(self.said), dict[str, Any]()
        while steps.tell() < len(self.said):
            told |= [pickle.load(steps)]
        log = self.case.folder.with_suffix(".stderr")
        stderr = log.read_text("utf-8", "replace")
        log.unlink()
        assert "made" in told and "broke" not in told, f"the suite broke: {told} {stderr}"
        if not keep:
            shutil.rmtree(self.case.folder, ignore_errors=True)
        return Verdict(self.case, *self._outcome(told, status, stderr), told, stderr)

    def _outcome(self, told: dict[str, Any], status: int, stderr: str) -> tuple[str, str]:
        code, peak = told.get("ran", (None, 0))
        memory = any(word in stderr for word in ("MemoryError", "bad_alloc", "not enough memory"))
        if peak > BYTES or memory:  # refused only by the limit that stands here
            return "over memory", f"{peak / 2**30:.1f} GiB"
        ended = -os.WTERMSIG(status) if code is None else code  # by itself, or as its shell says
        if ended == -signal.SIGXCPU or (code is None and self.killed):
            return "hang", f"more than {self.case.seconds:g} s"
        if code is None:
            return "crash", f"exit code {os.waitstatus_to_exitcode(status)} without a word"
        if code == 0:
            why = told.get("judged", f"its judge did not come to an end (status {status})")
            return ("wrong", why) if why else ("right", "")
        if "Traceback" in stderr or code != 2:
            return "traceback", f"exit code {code}"
        why = unclear(stderr, told["made"], self.case)
        return ("unclear", why) if why else ("clear", "")


def _in_child(case: Case, write: int) -> None:
    """Make the case, run it, judge it; each step is told by the pipe. Does not return."""
    try:
        os.setsid()
        silent = os.open(os.devnull, os.O_RDWR)
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        heard = os.open(case.folder.with_suffix(".stderr"), flags)
        for number, target in enumerate((silent, silent, heard)):
            os.dup2(target, number)
        change = case.make()
        os.write(write, pickle.dumps(("made", change)))
        os.chdir(case.folder)
        before = _limit(case.seconds)
        try:
            code = case.run()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        except BaseException:
            traceback.print_exc()
            code = 1
        sys.stderr.flush()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
        os.write(write, pickle.dumps(("ran", (code, peak))))
        _limit(3 * case.seconds)
        if code == 0:
            os.dup2(silent, 2)
            os.write(write, pickle.dumps(("judged", case.judge(change))))
    except BaseException:
        os.write(write, pickle.dumps(("broke", traceback.format_exc())))
    os._exit(0)


def _limit(seconds: float) -> int:
    """Keep this process from more than so much time and `BYTES` from here on; returns its peak."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    peak, data = (int(status[name].split()[0]) * 1024 for name in ("VmHWM", "VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (data + BYTES, resource.RLIM_INFINITY))
    used = resource.getrusage(resource.RUSAGE_SELF)
    until = int(used.ru_utime + used.ru_stime + seconds + 1)
    resource.setrlimit(resource.RLIMIT_CPU, (until, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    return peak


def run_cases(cases: Sequence[Case], jobs: int, keep: bool = False) -> Iterator[Verdict]:
    """Run cases, `jobs` at a time; their verdicts as they come."""
    waiting, running = list(reversed(cases)), dict[int, _Child]()
    while waiting or running:
        while waiting and len(running) < jobs:
            child = _Child(waiting.pop())
            running[child.pipe] = child
        ready = select.select(running, [], [], 0.2)[0]
        for child in [c for pipe, c in running.items() if c.listen(pipe in ready)]:
            yield running.pop(child.pipe).verdict(keep)


def in_child(work: Callable[[], object]) -> None:
    """Do something that computes, in a process of its own: this one stays as it is."""
    child = os.fork()
    if not child:
        try:
            os.dup2(os.open(os.devnull, os.O_RDWR), 1)
            work()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 0, "the corpus cannot be made, see above"
