"""torch.compile, and what it needs."""

import random
from collections.abc import Callable
from typing import Any

import torch

from pipeline.base.errors import ConfigError


def compiled(loss: Callable[..., Any], device: torch.device) -> Callable[..., Any]:
    """The same function, compiled at its first call, with the random numbers of eager torch.

    Raises `ConfigError` where this machine cannot compile for the device (torch.compile writes C++
    for a CPU and Triton for a GPU, and needs their compilers), and so does the function where the
    code that torch writes for this loss does not compile.
    """
    # A number never seen before, so that no result of an earlier compilation is found in a cache.
    number = random.SystemRandom().random()
    try:
        torch.compile(lambda x: x * number + x.sin())(torch.ones(2, device=device))
    except RuntimeError as error:  # torch's BackendCompilerFailed; its other names are private
        needed = "a C++ compiler (g++ or clang++, or the one that CXX names)"
        if device.type == "cuda":
            needed = "Triton and a C compiler"
        raise ConfigError(
            f"train_head.compile: expected {needed} and Python's headers, by which torch.compile "
            f"makes code for {device}, found that it fails: {_first_line(error)}. Install them, or "
            "set train_head.compile=false: the numbers are the same within float noise."
        ) from None
    from torch._dynamo.exc import BackendCompilerFailed  # it costs a second, and nobody else

    # Inductor would draw dropout and noise from a generator of its own.
    inner = torch.compile(loss, options={"fallback_random": True})

    def checked(*arguments: Any) -> Any:
        try:
            return inner(*arguments)
        except BackendCompilerFailed as error:
            raise ConfigError(
                f"train_head.compile: torch {torch.__version__} fails to compile this policy for "
                f"{device}: {_first_line(error)}. Set train_head.compile=false: the numbers are "
                "the same within float noise."
            ) from None

    return checked


def _first_line(error: Exception) -> str:
    """What torch says after the name of its backend."""
    said = (line.strip() for line in str(error).splitlines())
    told = (line for line in said if line and not line.startswith("backend="))
    return next(told, type(error).__name__)
