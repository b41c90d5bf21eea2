"""Commands that a message advises to run next; each runs as printed."""

import re
import shlex
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

DEFAULT_PARAMS = Path("params.yaml")
_NOT_REPEATED = (
    "extract.plan",
    "train_head.anew",
    "stores.remove",
    "verify.repair",
    "archive.restore",
)
"""Keys that concern only the running command."""
_repeated: list[str] = []
"""Options of the running command that the next one needs too; global, so that threads see them."""


@contextmanager
def running_with(params: Path, overrides: Sequence[str]) -> Generator[None]:
    """Within this context, `command` repeats this params file and these `section.key=value`s."""
    latest: dict[str, str] = {}
    for override in overrides:
        key = override.partition("=")[0]
        latest.pop(key, None)  # the latest setting comes last
        latest[key] = override
    settings = [f"--set {shlex.quote(o)}" for key, o in latest.items() if key not in _NOT_REPEATED]
    file = [] if params == DEFAULT_PARAMS else [f"--params {shlex.quote(str(params))}"]
    before, _repeated[:] = list(_repeated), [*file, *settings]
    try:
        yield
    finally:
        _repeated[:] = before


def command(stage: str, *options: str) -> str:
    """`python -m stages.<stage>` with its options, for a shell.

    It repeats the params file and the settings of the running command, except those that `options`
    set (as `pipeline.base.config.setting` writes them).
    """
    own = {_key(option) for option in options}
    repeated = [option for option in _repeated if _key(option) not in own - {None}]
    return " ".join([f"python -m stages.{stage}", *options, *repeated])


def _key(option: str) -> str | None:
    """The key that `--set key=value` sets."""
    setting = re.match(r"--set '?([\w.]+)=", option)
    return setting[1] if setting else None
