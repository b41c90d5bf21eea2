"""Several stores of one feature spec and embodiment -> one, without the model.

`joining` says which episodes and whether they fit, `copying` moves their rows, `union` builds.
"""

from pipeline.store.merging.union import MergeReport, merge

__all__ = ["MergeReport", "merge"]
