"""Objects of the user's own code, named in params as `module:name`."""

import inspect
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from pipeline.base.errors import ConfigError


def make_named(key: str, name: str, arguments: Mapping[str, Any] | None = None) -> Any:
    """What the class or function `module:name` gives for these arguments.

    Raises `ConfigError`, which names the params' `key`, where there is none, or where the arguments
    do not fit.
    """
    module, _, made = name.partition(":")
    if "" not in sys.path:
        sys.path.insert(0, "")  # the current folder, as with `python -m`
    try:
        home = import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"{key}: {name}: {error}. Name a class or function of a module that python finds from "
            f"{Path.cwd()}"
        ) from error
    made_by = getattr(home, made, None)
    if made_by is None:
        raise ConfigError(
            f"{key}: {name}: expected {made} in {home.__file__}, found none. Name a class or "
            "function that this module has"
        )
    try:
        bound = inspect.signature(made_by).bind(**arguments or {})
    except TypeError as error:
        raise ConfigError(f"{key}_args: {name}: {error}") from None
    return made_by(*bound.args, **bound.kwargs)
