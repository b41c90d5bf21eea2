"""What every command shares: its options, its exit codes, a clean stop."""

import argparse
import json
import os
import re
import select
import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.base.config import Params

_NUMBERS = ("N", "RATE", "S")
"""Names of values that are numbers; the value of every other option stays text."""
_YAML_WORDS = ("null", "true", "false", "yes", "no", "on", "off")
STOPPED = "stopped; run the same command again"


@dataclass(frozen=True)
class Shorthand:
    """An option or argument of a command that stands for `--set <key>=<its value>`."""

    name: str
    """`--option`, or the name of a positional argument."""
    key: str
    """section.key of params.yaml."""
    help: str
    value: str | None = None
    """The name of the value in the help; None for an option without a value, which means true."""
    nargs: str | None = None
    """As in argparse: `"*"` takes a list; with `"?"` the value may be left out and is then true."""
    repeated: bool = False
    """Whether commands that a message advises to run next need it, too."""
    alone: bool = False
    """Whether the command needs no params.yaml where this is given."""

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Add it to the parser."""
        text = f"{self.help} (--set {self.key}=…)"
        if self.value is None:
            parser.add_argument(self.name, action="store_const", const=True, help=text)
        else:
            const = True if self.nargs == "?" else None
            parser.add_argument(
                self.name, metavar=self.value, nargs=self.nargs, const=const, help=text
            )

    def override(self, options: argparse.Namespace) -> list[str]:
        """The `section.key=value` it stands for, if it was given."""
        value: Any = getattr(options, self.name.lstrip("-"))
        if value is None or value == []:
            return []
        return [f"{self.key}={value if self._stays(value) else json.dumps(value)}"]

    def _stays(self, value: Any) -> bool:
        """Whether a value is laid over as typed: a number, or a word that YAML reads as itself."""
        if not isinstance(value, str) or not re.fullmatch(r"[\w.+-]+", value):
            return False
        text = value[0].isalpha() and value.lower() not in _YAML_WORDS
        return text or self.value in _NUMBERS


_SHORT = {
    option.name: option
    for option in (
        Shorthand("--data", "root", "the folder of the recordings", "FOLDER"),
        Shorthand("--views", "views", "the cameras to use", "VIEW", "+"),
        Shorthand("--store", "store", "the store", "FOLDER"),
        Shorthand("--checkpoint", "checkpoint", "a trained policy", "FOLDER"),
        Shorthand("--expert", "model_type", "regression, diffusion or flow_matching", "NAME"),
        Shorthand("--lr", "lr", "learning rate", "RATE"),
        Shorthand("--steps", "max_steps", "optimizer steps", "N"),
        Shorthand("--batch", "batch_size", "samples or rows at a time", "N"),
        Shorthand("--device", "device", "auto, cpu or cuda:N", "NAME"),
        Shorthand("--out", "output", "the folder to write", "FOLDER"),
    )
}
"""Options that several commands have, each with its key in the command's section."""


def short(section: str, *options: str) -> tuple[Shorthand, ...]:
    """Options for the keys of a section that people set most often."""
    chosen = (_SHORT[option] for option in options)
    return tuple(replace(o, key=f"{section}.{o.key}", repeated=True) for o in chosen)


def run(
    summary: str,
    work: "Callable[[Params], None]",
    arguments: Sequence[str] | None = None,
    shorthands: Sequence[Shorthand] = (),
    sections: Sequence[str] = (),
    prog: str | None = None,
) -> int:
    """Parse the options, do the work, return the exit code.

    The code is 0 when the work is done, and 2 for what the user can mend, with one message and no
    traceback. It is 1 after Ctrl-C or SIGTERM, if the reader of the output has gone (`| head`), or
    after a bug, which keeps its traceback. `--help` imports nothing; `work` itself imports what
    takes seconds. `sections` are the sections of params.yaml that `--keys` lists.
    """
    signalled: list[int] = []
    with _stopped_by_signals(signalled):
        try:
            options = parser_of(summary, shorthands, sections, prog).parse_args(arguments)
            return _run(work, options, shorthands, sections)
        except (KeyboardInterrupt, ImportError) as error:
            # An interrupted import may end as an ImportError.
            if isinstance(error, ImportError) and not signalled:
                raise
            print(STOPPED, file=sys.stderr)
            return 1


def _run(
    work: "Callable[[Params], None]",
    options: argparse.Namespace,
    shorthands: Sequence[Shorthand],
    sections: Sequence[str],
) -> int:
    """Do what `run` does after it has parsed the options."""
    from pipeline.base.config import Params, described_keys, load_params
    from pipeline.base.errors import PipelineError
    from pipeline.base.printed_commands import DEFAULT_PARAMS, running_with

    try:
        if options.keys:
            print("\n".join(described_keys(sections or tuple(Params.model_fields))))
        else:
            given = [pair for shorthand in shorthands for pair in shorthand.override(options)]
            alone = any(shorthand.alone and shorthand.override(options) for shorthand in shorthands)
            absent = alone and options.params == DEFAULT_PARAMS and not DEFAULT_PARAMS.exists()
            if absent:
                print(f"no {DEFAULT_PARAMS} in this folder: every key has its default")
            params = load_params(None if absent else options.params, [*options.overrides, *given])
            again = (shorthand for shorthand in shorthands if shorthand.repeated)
            repeated = [pair for shorthand in again for pair in shorthand.override(options)]
            with running_with(options.params, [*options.overrides, *repeated]):
                work(params)
            if os.environ.get("DVC_STAGE"):
                _print_times()
        sys.stdout.flush()  # here, where an error is handled: at the interpreter's exit it is not
    except PipelineError as error:
        message = str(error)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _is_unread():
            # The text that stdout still holds must not fail again when the interpreter exits.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0 if options.keys else 1  # a reader of the keys has read enough
        place = f"{error.filename}: " if error.filename else ""
        message = f"{place}{error.strerror or error}. Look at that path, then run the same again."
    else:
        return 0
    print(f"error: {message}", file=sys.stderr)
    return 2


def _print_times() -> None:
    """Print how long this stage of a DVC run took, and how long the run has taken so far."""
    import psutil

    from pipeline.base.text import duration

    stage, now = psutil.Process(), time.time()
    runs = [p for p in stage.parents() if any(Path(w).name == "dvc" for w in p.cmdline()[:3])]
    so_far = f", {duration(now - runs[0].create_time())} since dvc began" if runs else ""
    print(f"{os.environ['DVC_STAGE']} took {duration(now - stage.create_time())}{so_far}")


@contextmanager
def _stopped_by_signals(signalled: list[int]) -> Generator[None]:
    """Within it, Ctrl-C and SIGTERM stop the work through every `finally`, and are noted.

    A signal that a shell or nohup has set to be ignored stays ignored.
    """

    def stop(signum: int, frame: FrameType | None) -> None:
        signalled.append(signum)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not cut a `finally`
        raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def parser_of(
    summary: str,
    shorthands: Sequence[Shorthand],
    sections: Sequence[str],
    prog: str | None = None,
) -> argparse.ArgumentParser:
    """The options of a command."""
    parser = argparse.ArgumentParser(
        prog=prog, description=summary, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--params", type=Path, default=Path("params.yaml"), metavar="FILE")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="section.key=value",
        help="lay a value (YAML) over the file; may be given several times",
    )
    parser.add_argument(
        "--keys",
        action="store_true",
        help=f"list the keys of {', '.join(sections) or 'params.yaml'}, with defaults, and exit",
    )
    for shorthand in shorthands:
        shorthand.add_to(parser)
    return parser


def _is_unread() -> bool:
    """Whether the reader of stdout or stderr has gone; other pipes break for other reasons."""
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        poll.register(stream, 0)
    return bool(poll.poll(0))
