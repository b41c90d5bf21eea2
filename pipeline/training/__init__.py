"""Training a policy head from a store: one loop, resumable at every checkpoint."""

from pipeline.training.loop import Trainer
from pipeline.training.run import Run, open_run
from pipeline.training.statistics import fit_normalization

__all__ = ["Run", "Trainer", "fit_normalization", "open_run"]
