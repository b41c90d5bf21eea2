"""Stage one: recordings x frozen model -> store.

`run` is the list of steps: `survey` says which episodes there are and reads them whole, `plan` what
will be done, `layout` writes all that needs no model, the one `engine` takes known rows over and
computes the others, in this process or on the workers of a `cluster`.
"""

from pipeline.extract.engine import ExtractionReport
from pipeline.extract.run import extract

__all__ = ["ExtractionReport", "extract"]
