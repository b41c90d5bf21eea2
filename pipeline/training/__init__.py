"""Training a policy: one loop for every expert, from a store or with a live model in front.

Resumable at every checkpoint; on one process, or on several that torchrun started.
"""

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
