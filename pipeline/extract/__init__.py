"""Stage one: recordings x frozen model -> store.

`run` is the list of steps: `survey` finds the episodes and reads them whole, `state` says what will
be done, `layout` writes everything that needs no model, and `engine` copies the known rows and lets
an executor compute the others: in this process, or on the workers of a `cluster`.
"""

from pipeline.extract.engine import ExtractionReport
from pipeline.extract.run import extract

__all__ = ["ExtractionReport", "extract"]
