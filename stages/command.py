"""What every command shares: its options, its exit codes, a clean stop."""

import os
import signal
import sys
from types import FrameType

STOPPED = "stopped; run the same command again"


def _stop_at_once(signum: int, frame: FrameType | None) -> None:
    """End without a traceback: while a command imports, it has begun nothing."""
    os.write(2, f"{STOPPED}\n".encode())
    os._exit(1)


def _stop_without_traceback() -> None:
    """Where this process is a command: until its work begins, which `_catch_signals` says.

    What a shell or nohup has told to be ignored stays so.
    """
    running = getattr(sys.modules["__main__"], "__spec__", None)
    if running is not None and running.name.startswith("stages."):
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
                signal.signal(number, _stop_at_once)


_stop_without_traceback()  # here, for what is imported below takes a while

import argparse
import json
import re
import select
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from pipeline.base.commands import DEFAULT_PARAMS, running_with
from pipeline.base.config import Params, described_keys, load_params
from pipeline.base.errors import PipelineError


@dataclass(frozen=True)
class Shorthand:
    """An option or argument of a command that stands for `--set <key>=<its value>`."""

    name: str
    """`--option`, or the name of a positional argument."""
    key: str
    """section.key of params.yaml."""
    help: str
    value: str | None = None
    """What the value is called in the help; None for an option that takes none and means true."""
    nargs: str | None = None
    """As argparse has it; `"*"` makes a list, `"?"` an option whose value may be left out: true."""

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Declare it."""
        said = f"{self.help} (--set {self.key}=…)"
        if self.value is None:
            parser.add_argument(self.name, action="store_const", const=True, help=said)
        else:
            left_out: dict[str, Any] = {"const": True} if self.nargs == "?" else {}
            parser.add_argument(
                self.name, metavar=self.value, nargs=self.nargs, help=said, **left_out
            )

    def override(self, options: argparse.Namespace) -> list[str]:
        """The `section.key=value` it stands for, if it was given."""
        given: Any = getattr(options, self.name.lstrip("-"))
        if given is None or given == []:
            return []
        # A word stays as it was typed, so that 8 is a number; else no character means anything.
        word = isinstance(given, str) and re.fullmatch(r"[\w.+-]+", given)
        return [f"{self.key}={given if word else json.dumps(given)}"]


def run(
    summary: str,
    work: Callable[[Params], None] | str,
    arguments: Sequence[str] | None = None,
    shorthands: Sequence[Shorthand] = (),
    sections: Sequence[str] = (),
) -> int:
    """Parse the options, do the work, return the exit code.

    0 done; 2 something the user can mend, said in one message without a traceback; 1 stopped by
    Ctrl-C or SIGTERM, by a reader of the output that has gone (`| head`), or by a bug, which keeps
    its traceback. `work` may name a module whose `main` it is: it is imported, which takes seconds,
    once options and params are known to be good. `sections` are those of params.yaml that `--keys`
    lists.
    """
    options = _parse(summary, arguments, shorthands, sections)
    try:
        if options.keys:
            print("\n".join(described_keys(sections or tuple(Params.model_fields))))
        else:
            given = (one for each in shorthands for one in each.override(options))
            params = load_params(options.params, [*options.overrides, *given])
            main = import_module(work).main if isinstance(work, str) else work
            _catch_signals()
            with running_with(options.params, options.overrides):
                main(params)
        sys.stdout.flush()  # not at the interpreter's exit, where an error is said in any case
    except PipelineError as error:
        return _refuse(str(error))
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _is_unread():
            # What stdout still holds must not fail again when the interpreter exits.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0 if options.keys else 1  # who reads keys has read enough
        place = f"{error.filename}: " if error.filename else ""
        said = f"{place}{error.strerror or error}. Look at that path, then run the same again."
        return _refuse(said)
    except KeyboardInterrupt:
        print(STOPPED, file=sys.stderr)
        return 1
    return 0


def _parse(
    summary: str,
    arguments: Sequence[str] | None,
    shorthands: Sequence[Shorthand],
    sections: Sequence[str],
) -> argparse.Namespace:
    """The options of a command."""
    parser = argparse.ArgumentParser(
        description=summary, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--params", type=Path, default=DEFAULT_PARAMS, metavar="FILE")
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
    return parser.parse_args(arguments)


def _refuse(said: str) -> int:
    print(f"error: {said}", file=sys.stderr)
    return 2


def _is_unread() -> bool:
    """Whether what reads stdout or stderr has gone; other pipes break for reasons of their own."""
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        poll.register(stream, 0)
    return bool(poll.poll(0))


def _catch_signals() -> None:
    """From here on Ctrl-C and SIGTERM stop through every `finally`."""
    if signal.getsignal(signal.SIGINT) is _stop_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminate)


def _terminate(signum: int, frame: FrameType | None) -> None:
    """Make SIGTERM stop as Ctrl-C does, through every `finally`, which no second one may cut."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt
