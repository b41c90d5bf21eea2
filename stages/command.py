"""What every command shares: its options, its exit codes, a clean stop."""

import argparse
import json
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

from pipeline.config import Params, described_keys, load_params
from pipeline.errors import PipelineError


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
    """As argparse has it; `"*"` makes a list."""

    @property
    def destination(self) -> str:
        """Under which name argparse hands the value out."""
        return self.name.lstrip("-").replace("-", "_")

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Declare it."""
        said = f"{self.help} (--set {self.key}=…)"
        if self.value is None:
            parser.add_argument(self.name, action="store_const", const=True, help=said)
        else:
            parser.add_argument(self.name, metavar=self.value, nargs=self.nargs, help=said)

    def override(self, options: argparse.Namespace) -> list[str]:
        """The `section.key=value` it stands for, if it was given."""
        given: Any = getattr(options, self.destination)
        if given is None or given == []:
            return []
        # A word stays as it was typed, so that 8 is a number; a list of paths becomes JSON.
        return [f"{self.key}={given if isinstance(given, str) else json.dumps(given)}"]


def run(
    summary: str,
    work: Callable[[Params], None] | str,
    arguments: Sequence[str] | None = None,
    shorthands: Sequence[Shorthand] = (),
    sections: Sequence[str] = (),
) -> int:
    """Parse the options, do the work, return the exit code.

    0 done; 2 something the user can mend, said in one message without a traceback; 1 stopped by
    Ctrl-C or SIGTERM, or a bug, which keeps its traceback. `work` may name a module whose `main` it
    is: it is imported, which takes seconds, once options and params are known to be good.
    `sections` are those of params.yaml that `--keys` lists.
    """
    parser = argparse.ArgumentParser(
        description=summary, formatter_class=argparse.RawDescriptionHelpFormatter
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
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        known = ["--params", "--set", "--keys", *(one.name for one in shorthands)]
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{_meant(unknown, known)}")
    if options.keys:
        print("\n".join(described_keys(sections or tuple(Params.model_fields))))
        return 0
    overrides = [
        *options.overrides,
        *(one for each in shorthands for one in each.override(options)),
    ]
    signal.signal(signal.SIGTERM, _terminate)
    try:
        params = load_params(options.params, overrides)
        main = import_module(work).main if isinstance(work, str) else work
        main(params)
    except PipelineError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        said = f"{place}{error.strerror or error}. Look at that path, then run the same again."
        print(f"error: {said}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; run the same command again", file=sys.stderr)
        return 1
    return 0


def _meant(unknown: Sequence[str], known: Sequence[str]) -> str:
    """A question about the first of some unknown arguments, where it looks like a known one."""
    first, *values = unknown
    name, equals, value = first.partition("=")
    if first.startswith("-"):
        near = get_close_matches(name, [one for one in known if one.startswith("-")], 1)
        meant = " ".join([near[0] + equals + value, *values]) if near else ""
    elif first.endswith((".yaml", ".yml")):
        meant = f"--params {first}"
    else:
        meant = f"--set {first}" if equals else ""
    return f"; did you mean {meant}?" if meant else ""


def _terminate(signum: int, frame: FrameType | None) -> None:
    """Make SIGTERM stop as Ctrl-C does, through every `finally`, which no second one may cut."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt
