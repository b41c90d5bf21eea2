"""Train robot policies on cached features of a frozen vision-language model.

  vla-cache NAME --help                    what a command does, its options
  vla-cache NAME --keys                    the keys of params.yaml that it reads

Each command is also python -m stages.NAME. dvc repro runs the whole pipeline with params.yaml.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from stages.command import run

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
    _parser().parse_args(words)
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
    parser.add_argument("command", nargs="?", choices=_NAMES, metavar="NAME")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
