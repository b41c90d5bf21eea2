"""Train robot policies on cached features of a frozen vision-language model.

  vla-cache NAME --help                    what a command does, its options
  vla-cache NAME --keys                    the keys of params.yaml that it reads
  source <(vla-cache --completion bash)    completion, for zsh and tcsh too

Each command is also python -m stages.NAME. dvc repro runs the whole pipeline with params.yaml.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import shtab

from stages.command import parser_of, run

PROGRAM = "vla-cache"
COMMANDS = {
    "the pipeline": ("demo", "extract", "train_head", "evaluate", "rollout"),
    "before you begin, and to look": ("doctor", "inspect", "probe", "compare"),
    "the model itself": ("finetune",),
    "stores": ("verify", "store", "archive"),
    "on a robot": ("serve", "drive", "export"),
    "to share": ("push",),
}
"""All commands, by what they are for."""
_NAMES = [name for names in COMMANDS.values() for name in names]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the named command; returns its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in _NAMES:
        stage: Any = import_module(f"stages.{words[0]}")
        shorthands = getattr(stage, "SHORTHANDS", ())
        prog = f"{PROGRAM} {words[0]}"
        return run(stage.__doc__, stage.main, words[1:], shorthands, stage.SECTIONS, prog)
    options = _parser().parse_args(words)
    if options.completion:
        print(shtab.complete(_with_all_options(), options.completion))
    else:
        _parser().print_help()
    return 0


def _parser() -> argparse.ArgumentParser:
    """The program without the options of its commands."""
    lines = [__doc__ or ""]
    for purpose, names in COMMANDS.items():
        lines += ["", f"{purpose}:"]
        for name in names:
            summary = (import_module(f"stages.{name}").__doc__ or "").split("\n")[0]
            lines.append(f"  {name:<12}{summary}")
    parser = argparse.ArgumentParser(
        PROGRAM,
        description="\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--completion", choices=shtab.SUPPORTED_SHELLS, help="print the script")
    parser.add_argument("command", nargs="?", choices=_NAMES, metavar="NAME")
    return parser


def _with_all_options() -> argparse.ArgumentParser:
    """The program with its commands and their options, for completion."""
    parser = argparse.ArgumentParser(PROGRAM)
    commands = parser.add_subparsers()
    for name in _NAMES:
        stage: Any = import_module(f"stages.{name}")
        summary = stage.__doc__.split("\n")[0]
        of_stage = parser_of(summary, getattr(stage, "SHORTHANDS", ()), stage.SECTIONS)
        commands.add_parser(name, help=summary, parents=[of_stage], add_help=False)
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
