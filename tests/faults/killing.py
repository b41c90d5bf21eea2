"""A kill before any step of a function, without a process."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

Step = tuple[Any, str]
"""A function that counts as a step, by its owner and name."""


class Killed(BaseException):
    """Stands for SIGKILL: nothing may catch it, and nothing after it runs."""


CHANGES: tuple[Step, ...] = (
    *((Path, name) for name in ("rename", "mkdir", "write_text", "unlink", "symlink_to")),
    (shutil, "rmtree"),
)
"""Of a folder."""


def killed_before(step: int, act: Callable[[], Any], steps: Iterable[Step] = CHANGES) -> bool:
    """Whether `act` was killed before its n-th of these steps."""
    count = iter(range(10**6))

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if next(count) == step:
                raise Killed
            return real(*args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in steps:
            patch.setattr(owner, name, counted(getattr(owner, name)))
        try:
            act()
        except Killed:
            return True
    return False
