"""Training a policy: one loop for every expert, from a store or with a live model in front.

Resumable at every checkpoint; on one process, or on several that torchrun started. Names come from
their modules when first asked for: most bring torch, and to see that a run is finished takes none.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.training.front import Cached, Front
    from pipeline.training.loggers import check_loggers
    from pipeline.training.loop import Trainer
    from pipeline.training.run import Run, open_run
    from pipeline.training.statistics import fit_normalization
    from pipeline.training.world import World, process_group

__all__ = [
    "Cached",
    "Front",
    "Run",
    "Trainer",
    "World",
    "check_loggers",
    "fit_normalization",
    "open_run",
    "process_group",
]
_MODULES = {
    "Cached": "front",
    "Front": "front",
    "Run": "run",
    "Trainer": "loop",
    "World": "world",
    "check_loggers": "loggers",
    "fit_normalization": "statistics",
    "open_run": "run",
    "process_group": "world",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
